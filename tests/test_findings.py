"""Findings in few words."""

from __future__ import annotations

import re
from operator import attrgetter
from pathlib import Path

import pytest

import asbuilt
from asbuilt.findings import Finding, list_findings


def test_a_brief_finding_says_more_than_the_name_of_its_recording() -> None:
    said = "run.csv: in the last half second joint 3 stands; see row 9"
    finding = Finding("stuck", "warning", said)
    assert finding.brief(50) == "run.csv: in the last half second joint 3 stands."


def test_one_code_at_several_joints_is_one_paragraph_that_names_them() -> None:
    found = [Finding("stuck", "warning", f"joint {name} stands", joint=name) for name in "ABC"]
    assert list_findings(found) == ["WARNING stuck: joint A stands; the same holds for B and C."]
    assert len(list_findings(found, full=True)) == 3


def test_findings_at_one_joint_of_two_logs_keep_the_names_of_both() -> None:
    found = [
        Finding("stuck", "warning", f"{log}: joint {joint} stands", joint=joint)
        for log in ("one.csv", "two.csv")
        for joint in "AB"
    ]
    assert list_findings(found) == [
        "WARNING stuck: one.csv: joint A stands; the same holds for B.",
        "WARNING stuck: two.csv: joint A stands; the same holds for B.",
    ]


def test_errors_come_first_and_each_by_itself() -> None:
    found = [
        Finding("stuck", kind, f"{kind} {name}", joint=name)
        for kind in ("info", "error")
        for name in "AB"
    ]
    assert [line.split(":")[0] for line in list_findings(found)] == ["ERROR stuck"] * 2 + [
        "INFO stuck"
    ]


CALLS = {
    call
    for path in Path(asbuilt.__file__).parent.rglob("*.py")
    for call in re.findall(r'call="([\w.]+)"', path.read_text(encoding="utf-8"))
}


@pytest.mark.parametrize("call", sorted(CALLS))
def test_a_cure_names_a_public_function(call: str) -> None:
    stage, _, _ = call.rpartition(".")
    if stage:
        __import__(f"asbuilt.{stage}")
    assert callable(attrgetter(call)(asbuilt))
