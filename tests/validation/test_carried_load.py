"""A load that a recording carries beyond the model is named, with its mass, and only then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import LinkInertia, load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import ReadingOptions, Recording, VirtualRobot, read_recording
from asbuilt.validation import study_verdict
from asbuilt.workflow import (
    PayloadOptions,
    Study,
    StudyOptions,
    identify,
    identify_payload,
    validate,
)

ROBOT = "ur10e"
MASS = 2.0
TOOL = LinkInertia.from_com(MASS, [0.02, 0.05, 0.1], 0.004 * np.eye(3))


def recorded(seed: int, *, loaded: bool) -> Recording:
    robot = VirtualRobot.typical(load_robot(ROBOT), rng=5)
    robot = robot.with_tool(TOOL, at="flange") if loaded else robot
    motion = random_fourier(robot.model, rng=seed, duration=20.0, n_harmonics=8)
    return robot.record(motion, rate=200.0, rng=seed).recording


OPTIONS = StudyOptions(method="wls", holdout=None, effects="none")


@pytest.fixture(scope="module")
def bare() -> Study:
    return identify(ROBOT, recorded(1, loaded=False), options=OPTIONS)


@pytest.mark.study
def test_a_load_is_named_with_its_mass_and_no_joint_is_blamed(bare: Study) -> None:
    log = recorded(2, loaded=True)
    (found,) = validate(bare, log)
    assert found.load is not None
    assert abs(found.load.mass - MASS) < 3.0 * found.load.std_error + 0.02
    assert found.load.relative_error < 0.3 * found.metrics_as_built.relative_error
    verdict = study_verdict(bare.result, (), (found,))
    assert verdict.reasons[0] == "payload_in_log"
    assert "carries a load of" in verdict.text
    assert not {"torque_unexplained", "cad_predicts_better"} & set(verdict.reasons)
    # The command for payloads says the same number.
    payload = identify_payload(bare, log)
    assert payload.values[0] == pytest.approx(found.load.mass, rel=0.01)


@pytest.mark.study
def test_a_load_that_is_gone_is_named_too() -> None:
    study = identify(ROBOT, recorded(1, loaded=True), options=OPTIONS)
    (found,) = validate(study, recorded(2, loaded=False))
    assert found.load is not None
    assert found.load.mass == pytest.approx(-MASS, rel=0.1)
    assert "lacks a load of" in found.load.text


@pytest.mark.study
def test_another_motion_without_a_load_names_none(bare: Study) -> None:
    (found,) = validate(bare, recorded(2, loaded=False))
    assert found.load is None


@pytest.mark.study
def test_a_wrong_mass_of_an_inner_link_is_no_load(bare: Study) -> None:
    """The upper arm five kilograms heavier: torques of the wrist are as before."""
    robot = VirtualRobot.typical(load_robot(ROBOT), rng=5)
    heavy = robot.with_tool(
        LinkInertia.from_com(5.0, [-0.3, 0.0, 0.1], 0.01 * np.eye(3)), at="upper_arm_link"
    )
    motion = random_fourier(robot.model, rng=2, duration=20.0, n_harmonics=8)
    (found,) = validate(bare, heavy.record(motion, rate=200.0, rng=2).recording)
    assert found.metrics_as_built.relative_error > 0.05
    assert found.load is None


@pytest.mark.study
def test_the_load_of_an_indy_is_named_and_no_sign_is_blamed(shared: Path) -> None:
    """Its joint 3 alone turns its gravity under the load, which looked like a wrong sign."""
    model = load_robot(shared / "models" / "indy" / "indy7.urdf")
    folder = shared / "data" / "indy"
    sheet = ReadingOptions(sheet=folder / "sheet.toml")
    logs = [
        folder / name for name in ("random_free_MonitoringDataLog7.txt", "joint_free_with_load.txt")
    ]
    one, other = (read_recording(log, model=model, options=sheet) for log in logs)
    study = identify(model, one, options=OPTIONS)
    (found,) = validate(study, other)
    assert found.load is not None
    assert found.load.mass > 3.0 * found.load.std_error > 0.0
    payload = identify_payload(study, other, options=PayloadOptions())
    assert payload.metrics[0].relative_error < 0.2 * found.metrics_as_built.relative_error
