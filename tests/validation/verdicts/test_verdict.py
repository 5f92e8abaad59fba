"""Verdicts: whether to use an identified model, by what the exported robot predicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.description.model import LinkInertia, MassRange
from asbuilt.dynamics import PositionServo
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, SignalChain, VirtualRobot, prepare_samples
from asbuilt.findings import Finding
from asbuilt.identification import FoundEffect
from asbuilt.tables import format_share
from asbuilt.validation import Rollout, RolloutErrors, study_verdict, validate_description
from asbuilt.workflow import Study, identify, validate
from asbuilt.workflow.prepare import group_by_motion
from asbuilt.writers import as_built, write_robot_toml


@pytest.fixture(scope="module")
def logs() -> list[Recording]:
    model = load_robot("scara")
    robot = VirtualRobot.typical(model, rng=5)
    return [
        robot.record(random_fourier(model, rng=seed, duration=12.0), rate=200.0, rng=seed).recording
        for seed in (1, 2)
    ]


@pytest.fixture(scope="module")
def study(logs: list[Recording]) -> Study:
    return identify("scara", logs[:1], validation=logs[1:])


def test_a_model_that_predicts_another_motion_is_used(study: Study) -> None:
    found = study.verdict
    assert (found.use, found.measure, found.reasons) == ("yes", "torque", ())
    assert found.text.startswith("USE: predicts other motion to ")
    assert found.error.cad is not None
    assert found.error.exported == pytest.approx(found.error.as_built, rel=0.2)


def test_the_error_is_that_of_the_robot_file(
    study: Study, logs: list[Recording], tmp_path: Path
) -> None:
    file = write_robot_toml(tmp_path / "robot.toml", as_built(study.result).model)
    samples = prepare_samples(logs[1], study.result.chain)
    written = validate_description(load_robot(file), samples).relative_error
    assert study.verdict.error.exported == pytest.approx(written, rel=1e-9)


def test_a_mass_that_torques_do_not_determine_is_not_in_the_first_line(study: Study) -> None:
    """Nothing bounds the mass of all links; a scale does, and then it is the robot file's."""
    assert np.isinf(study.result.feasible("mass").greatest)
    assert " kg" not in study.verdict.text
    mass = sum(float(link.inertia.mass) for link in as_built(study.result).model.links)
    limits = MassRange(study.result.model.link_names, 0.99 * mass, 1.01 * mass)
    weighed = replace(study.result.model, mass_ranges=(limits,))
    text = study_verdict(replace(study.result, model=weighed), (), study.validations).text
    assert f", {mass:.3g} kg for " in text


def test_training_data_alone_are_no_test(logs: list[Recording]) -> None:
    """The error of what was fitted is no promise: the sentence has it, the numbers have none."""
    study = identify("scara", logs[:1], holdout="none")
    found = study.verdict
    assert (found.use, found.reasons[0]) == ("untested", "nothing_held_out")
    fits = format_share(study.result.train.relative_error, 2)
    assert found.text.startswith(f"UNTESTED: fits its log to {fits}; record another motion")
    assert (found.error.as_built, found.error.exported) == (None, None)
    assert {each.use for each in found.joints} == {"untested"}
    assert {each.error for each in found.joints} == {None}


@pytest.mark.parametrize(("seen", "use"), [(True, "untested"), (False, "yes")])
def test_simulated_motion_of_training_data_is_no_test_either(
    study: Study, seen: bool, use: str
) -> None:
    """Where commands stand for torques motion is measured, of the same log or of another."""
    model = study.result.model
    size = np.full(model.n_joints, 2e-3)
    errors = RolloutErrors(size, 2e-3, size, None, 0, 0.5, size, 2e-3, "mrad")
    rollout = Rollout(0.5, "command", (), errors, errors, None, None, ())
    servo = PositionServo(kp=size, kd=size)
    result = replace(study.result, servo=servo)
    finding = Finding("nothing_held_out", "warning", "the result was identified from these logs")
    found = study_verdict(result, (finding,) if seen else (), study.validations, (rollout,))
    assert (found.measure, found.use) == ("rollout", use)
    if seen:
        assert found.reasons[0] == "nothing_held_out"
        assert found.text.startswith("UNTESTED: simulates its log to 2 ")
        assert found.text.endswith("; record another motion.")
        assert (found.error.as_built, found.error.exported) == (None, None)


def test_whole_recordings_are_left_out_in_turn(logs: list[Recording]) -> None:
    """Each is predicted as by a study of the other with the same effects, to the last digits."""
    named = [replace(each, source=f"log {k}") for k, each in enumerate(logs)]
    options = {"method": "wls", "effects": "none", "chain": SignalChain(cutoff=10.0, delay=None)}
    both = identify("scara", named, **options)
    assert both.result.holdout == "recordings"
    for k, found in enumerate(both.validations):
        alone = identify("scara", named[1 - k], validation=named[k], **options).validations[0]
        np.testing.assert_allclose(
            found.metrics_as_built.rms, alone.metrics_as_built.rms, rtol=1e-6
        )
        (again,) = validate(both.result, named[k])
        np.testing.assert_array_equal(again.metrics_as_built.rms, found.metrics_as_built.rms)
    assert " predicts other motion to " in both.verdict.text
    whole = identify("scara", named, holdout=None, **options)
    np.testing.assert_array_equal(both.result.estimates, whole.result.estimates)


def test_recordings_of_one_motion_are_not_left_out_alone(logs: list[Recording]) -> None:
    """What a copy of the recording predicts is no other motion."""
    robot = VirtualRobot.typical(load_robot("scara"), rng=5)
    motion = random_fourier(load_robot("scara"), rng=1, duration=12.0)
    copy = robot.record(motion, rate=200.0, rng=9).recording
    twins = [replace(each, source=name) for name, each in (("a", logs[0]), ("b", copy))]
    assert identify("scara", twins, method="wls", effects="none").result.holdout == "blocks:2s:3"
    three = [*twins, replace(logs[1], source="c")]
    samples = [prepare_samples(each, SignalChain(cutoff=10.0, delay=None)) for each in three]
    assert group_by_motion(samples) == ((0, 1), (2,))


def test_a_joint_that_is_not_explained_is_not_for_use(study: Study) -> None:
    (validation,) = study.validations
    metrics = validation.metrics_exported
    assert metrics is not None
    shares = metrics.relative_error_per_joint.copy()
    # 97 % of the torque of a joint that carries little: the norm over all joints hides it.
    shares[3] = 0.97
    spoilt = replace(validation, metrics_exported=replace(metrics, relative_error_per_joint=shares))
    found = study_verdict(study.result, (), (spoilt,))
    assert [each.use for each in found.joints] == ["yes", "yes", "yes", "no"]
    assert found.joints[3].error == pytest.approx(0.97)
    assert found.text.startswith(
        "USE WITH CARE: not for use at joint_4 (97 % of the torque unexplained); predicts"
    )


@pytest.mark.parametrize(("factor", "use"), [(1.0, "yes"), (1.2, "yes"), (4.0, "no")])
def test_absurd_bodies_are_not_for_use_as_bodies(study: Study, factor: float, use: str) -> None:
    """Against a description of another mass the bodies differ, and the torque is as good."""
    model = study.result.model
    light = model.with_parameters(model.parameters / factor)
    result = replace(study.result, model=light)
    found = study_verdict(result, (), study.validations)
    assert found.bodies.use == use
    assert found.text.startswith("USE" if use == "yes" else "USE for torque: predicts")
    assert ("; DO NOT USE as bodies: " in found.text) == (use == "no")
    assert found.use_for_torque == "yes"
    assert bool(found.bodies.reasons) == (use != "yes")


def test_a_link_that_cannot_be_in_cad_is_measured_by_what_it_states_too(
    study: Study, logs: list[Recording]
) -> None:
    """Its mass may be the true one, and torques of a SCARA never see inertia about x and y."""
    model = study.result.model
    link = model.links[1].inertia
    tensor = link.inertia_about_com + np.diag([100.0, 100.0, 0.0])
    odd = LinkInertia.from_com(link.mass, link.com, tensor)
    bodies = [odd if k == 1 else each.inertia for k, each in enumerate(model.links)]
    described = model.with_parameters(np.concatenate([body.parameters for body in bodies]))
    measured = study_verdict(replace(study.result, model=described), (), study.validations)
    assert "of CAD" not in measured.bodies.text
    found = identify(described, logs[:1], validation=logs[1:]).verdict
    name = model.link_names[1]
    assert found.use_for_torque == "yes"
    assert (found.bodies.use, found.bodies.reasons) == ("with care", ("implausible_bodies",))
    assert f"mass and inertia of {name} cannot be of one link, nor are CAD's" in found.text


def test_data_that_repeat_the_training_motion_earn_no_use(study: Study) -> None:
    repeated = Finding("held_out_repeats", "warning", "log repeats the training motion")
    found = study_verdict(study.result, (*study.findings, repeated), study.validations)
    assert found.use == "with care"
    assert found.text.startswith("USE WITH CARE: tested on the same motion only; ")


@pytest.mark.parametrize(
    ("effect", "in_model", "use"),
    [
        ("tilt", False, "with care"),
        ("gain", False, "with care"),
        ("tilt", True, "yes"),
        ("presliding", False, "yes"),
    ],
)
def test_what_is_named_but_not_in_the_model_dims(
    study: Study, effect: str, in_model: bool, use: str
) -> None:
    found = FoundEffect(effect, None, 1.3, 0.1, "deg", in_model, 1.0, 0.05, 0.03, (), "")
    result = replace(study.result, effects=(found,))
    assert study_verdict(result, study.findings, study.validations).use == use


@pytest.mark.parametrize(("cad", "use"), [(2.0, "yes"), (0.9, "with care"), (0.5, "no")])
def test_a_model_behind_cad_is_not_used(study: Study, cad: float, use: str) -> None:
    (validation,) = study.validations
    metrics = validation.metrics_exported
    assert metrics is not None
    by_cad = replace(metrics, relative_error=cad * metrics.relative_error)
    found = study_verdict(study.result, (), (replace(validation, metrics_cad=by_cad),))
    assert found.use == use
    assert ("cad_predicts_better" in found.reasons) == (cad < 1.0)


def test_a_recording_with_errors_forbids(study: Study) -> None:
    wrong = Finding("clock_unit", "error", "time has another unit")
    found = study_verdict(study.result, (wrong,), study.validations)
    assert found.text.startswith("DO NOT USE: time has another unit; ")


def test_several_recordings_count_by_the_worst(logs: list[Recording], study: Study) -> None:
    (validation,) = study.validations
    worse = replace(
        validation, metrics_exported=replace(validation.metrics_as_built, relative_error=0.4)
    )
    found = study_verdict(study.result, (), (validation, worse))
    assert found.error.exported == 0.4
    assert found.use == "with care"


def test_a_verdict_is_stored_with_its_study(study: Study) -> None:
    again = Study.from_json(study.to_json())
    assert again.verdict == study.verdict
    assert not again.validations
    assert np.isfinite(again.verdict.error.exported or np.nan)
