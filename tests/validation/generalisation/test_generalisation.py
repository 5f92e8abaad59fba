"""What is said of several recordings is said once."""

from __future__ import annotations

from asbuilt.findings import Finding
from asbuilt.validation.generalisation.generalisation import _merge_by_code


def test_the_same_finding_on_several_recordings_is_one_warning() -> None:
    found = [
        (
            "a.csv",
            Finding("does_not_generalise", "warning", "Errors on a.csv exceed those trained"),
        ),
        ("a.csv", Finding("cad_predicts_better", "warning", "CAD predicts a.csv better")),
        (
            "b.csv",
            Finding("does_not_generalise", "warning", "Errors on b.csv exceed those trained"),
        ),
    ]
    said = _merge_by_code(found)
    assert [(each.code, each.severity) for each in said] == [
        ("does_not_generalise", "warning"),
        ("cad_predicts_better", "warning"),
    ]
    assert said[0].message == "Errors on a.csv exceed those trained; likewise on b.csv"
