"""Findings merged by cause, and ordered by torque."""

from asbuilt.findings import Cure, Finding
from asbuilt.validation.generalisation.consolidation import consolidate_findings


def warning(code, message="something is off", joint=None):
    return Finding(code, "warning", message, Cure("look"), joint=joint)


def warnings_of(findings):
    return [each for each in findings if each.severity == "warning"]


def test_one_warning_names_the_joints_of_the_others():
    found = consolidate_findings(
        [warning("torque_scale", f"log.csv: {name} is off", name) for name in ("A1", "A2", "A3")]
    )
    (only,) = warnings_of(found)
    assert only.message == "log.csv: A1 is off; likewise A2 and A3"
    assert found == (only,)


def test_one_warning_names_the_recordings_of_the_others():
    found = consolidate_findings(
        [
            warning("end_transient", "one.csv: A1 is off", "A1"),
            warning("end_transient", "two.csv: A2 is off", "A2"),
            warning("weak_excitation", "one.csv: too little"),
            warning("weak_excitation", "two.csv: too little"),
        ]
    )
    assert [each.message for each in warnings_of(found)] == [
        "one.csv: A1 is off; likewise in two.csv",
        "one.csv: too little; likewise in two.csv",
    ]
    assert len(found) == 2


def test_warnings_are_ordered_by_the_torque_that_they_concern():
    found = consolidate_findings(
        [warning("one", joint="A1"), warning("two", joint="A2"), warning("three")],
        {"A1": 0.1, "A2": 0.7},
    )
    assert [(each.code, each.torque) for each in found] == [
        ("two", 0.7),
        ("one", 0.1),
        ("three", None),
    ]


def test_what_another_warning_explains_is_information_and_only_then():
    alone = consolidate_findings([warning("consistent_fit_costly")])
    assert [each.severity for each in alone] == ["warning"]
    beside = consolidate_findings([warning("consistent_fit_costly"), warning("effect_found")])
    assert [(each.code, each.severity) for each in beside] == [
        ("effect_found", "warning"),
        ("consistent_fit_costly", "info"),
    ]


def test_errors_stay_first_and_apart_and_causes_come_before_symptoms():
    errors = [Finding("not_finite", "error", "bad", joint=name) for name in ("A1", "A2")]
    found = consolidate_findings(
        [
            warning("nothing_held_out"),
            warning("poorly_determined"),
            warning("effect_found"),
            *errors,
        ]
    )
    assert [each.code for each in found] == [
        "not_finite",
        "not_finite",
        "effect_found",
        "poorly_determined",
        "nothing_held_out",
    ]
    assert found[:2] == tuple(errors)
