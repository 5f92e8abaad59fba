"""Findings in few words."""

from __future__ import annotations

from asbuilt.findings import Finding


def test_a_brief_finding_says_more_than_the_name_of_its_recording() -> None:
    said = "run.csv: in the last half second joint 3 stands; see row 9"
    finding = Finding("stuck", "warning", said)
    assert finding.brief(50) == "run.csv: in the last half second joint 3 stands."
