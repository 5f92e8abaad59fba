"""The score of named effects, on results that are made up."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from effect_score import Effect, Row, Truth, by_family, score
from named_effects import named_effects

SPRING = Truth("spring", "j2", 4.0, "N m/rad", 0.8)
TILT = Truth("tilt", None, 3.0, "deg about y")


def row(
    truth: tuple[Truth, ...] = (), named: tuple[Effect, ...] = (), number: int = 0, **more: object
) -> Row:
    return Row(number, "scara", truth, named, **more)  # type: ignore[arg-type]


def test_an_effect_is_named_at_its_joint_only() -> None:
    assert row((SPRING,), (Effect("spring", "j2"),)).found(SPRING) == "named"
    elsewhere = row((SPRING,), (Effect("spring", "j3"),))
    assert elsewhere.found(SPRING) == "missed"
    assert elsewhere.false_names() == (Effect("spring", "j3"),)


def test_an_alternative_is_neither_named_nor_false() -> None:
    cable = Effect("cable", "j2", alternatives=(("spring", "j2"), ("zero", "j2")))
    found = row((SPRING,), (cable,))
    assert found.found(SPRING) == "alternative"
    assert not found.false_names()
    assert row((), (cable,)).false_names() == (cable,)


def test_effects_of_the_robot_need_no_joint_and_couplings_may_be_at_either() -> None:
    assert row((TILT,), (Effect("tilt"),)).found(TILT) == "named"
    coupled = Truth("coupling", "j3", 0.5, "", 1.0, ("j2",))
    assert [
        row((coupled,), (Effect("coupling", j),)).found(coupled) for j in ("j1", "j2", "j3")
    ] == ["missed", "named", "named"]


def test_springs_and_cylinders_between_points_are_one_family() -> None:
    cylinder = Truth("balancer", "j2", 100.0, "N m")
    assert row((cylinder,), (Effect("gravity_spring", "j2"),)).found(cylinder) == "named"
    assert row((cylinder,), (Effect("spring", "j2"),)).found(cylinder) == "missed"


@pytest.mark.parametrize(
    ("estimate", "right"), [((0.1, 2.9), (True,)), ((2.9, -0.1), (False,)), (-3.0, (False,))]
)
def test_the_sign_of_a_tilt_is_that_about_its_axis(
    estimate: float | tuple[float, float], right: tuple[bool]
) -> None:
    assert row((TILT,), (Effect("tilt", estimate=estimate),)).turns_right() == right


def test_shares_count_effects_and_false_names_count_robots() -> None:
    false = (Effect("zero", "j1"), Effect("gain", "j1"))
    rows = [
        row((SPRING, TILT), (Effect("spring", "j2"),), 0, errors={"none": 0.04, "auto": 0.03}),
        row((), false, 1, errors={"none": 0.02, "auto": 0.03}),
        row((), (), 2),
        row((SPRING,), (Effect("spring", "j2"),), 3, problem="RecordingError"),
    ]
    found = score(rows)
    assert (found.robots, found.effects, found.problems) == (3, 2, 1)
    assert found.named == 0.5
    assert found.named_visible == 1.0
    assert found.falsely == pytest.approx(1 / 3)
    assert found.falsely_alone == 0.5
    assert found.ratio == pytest.approx(0.75)
    assert found.worse == 0.5
    assert found.errors == {"auto": 0.03, "none": 0.03}
    assert by_family(rows) == {
        "gain": (0, 0, 0, 1),
        "spring": (2, 2, 0, 0),
        "tilt": (1, 0, 0, 0),
        "zero": (0, 0, 0, 1),
    }


def test_a_row_goes_through_json_unchanged() -> None:
    effect = Effect("tilt", None, (0.1, 2.9), None, "deg", (("spring", "j1"),))
    given = row((TILT, SPRING), (effect,), 7, errors={"none": 0.1}, seconds=2.0)
    read = Row.from_json(json.loads(json.dumps(given.as_json())))
    assert read.truth[1] == SPRING
    assert read.found(SPRING) == given.found(SPRING)
    assert read.named[0].alternatives == effect.alternatives
    assert read.turns_right() == (True,)


def test_effects_of_a_study_are_read_from_objects_and_from_json(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("named_effects.APPLIED", True)
    fields = {"effect": "zero", "joint": "j2", "estimate": 1.5, "std_error": 0.1, "unit": "deg"}
    other = SimpleNamespace(effect="spring", joint="j2")
    each = SimpleNamespace(**fields, alternatives=(other,))
    for effects in ((each,), [fields | {"alternatives": ["spring at j2"]}]):
        study = SimpleNamespace(
            effects=effects, findings=(), attribution=None, result=SimpleNamespace(joint_names=())
        )
        (named,) = named_effects(study)  # type: ignore[arg-type]
        assert named == Effect("zero", "j2", 1.5, 0.1, "deg", (("spring", "j2"),))


@pytest.mark.parametrize(
    "text",
    [
        "base tilt 3.01 +- 0.10 deg (-0.21 about x, +3.00 about y): torque error 4 -> 2 %",
        "base tilt of -0.21 +- 0.01 deg about x and 3.00 +- 0.02 deg about y relative to",
    ],
)
def test_the_parts_of_a_tilt_are_read_from_its_sentence(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("named_effects.APPLIED", True)
    tilt = {"effect": "tilt", "joint": None, "estimate": 3.01, "std_error": 0.1, "text": text}
    study = SimpleNamespace(
        effects=[tilt], findings=(), attribution=None, result=SimpleNamespace(joint_names=())
    )
    (named,) = named_effects(study)  # type: ignore[arg-type]
    assert named.estimate == (-0.21, 3.0)
