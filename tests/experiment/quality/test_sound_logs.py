"""Sound logs of wrong descriptions are not refused; real errors of the log are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import load_robot, read_recording
from asbuilt.description import RobotModel, bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording, simulate_recording


@pytest.fixture(scope="module")
def arm() -> RobotModel:
    return bundled_robot("kuka-iiwa7-r800")


@pytest.fixture(scope="module")
def log(arm: RobotModel) -> Recording:
    return simulate_recording(arm, random_fourier(arm, rng=3), rate=200.0, rng=4)


def test_placeholder_limits_of_velocity_are_no_degrees(arm: RobotModel, log: Recording) -> None:
    joints = tuple(replace(j, limits=replace(j.limits, velocity=0.1)) for j in arm.joints)
    check = check_recording(replace(arm, joints=joints), log)
    assert check.ok
    assert "limits_doubted" in check.codes
    stated = replace(log, q=np.degrees(log.q), qd=None, stated=frozenset({"position"}))
    assert "degrees" not in check_recording(arm, stated).codes


def test_a_load_does_not_flip_a_sign(shared: Path) -> None:
    """A load turns the sign of gravity at joint 3; the controller's own model has it."""
    model = load_robot(str(shared / "models/indy/indy7.urdf"))
    log = read_recording(
        shared / "data/indy/joint_free_with_load.txt",
        model=model,
        sheet=shared / "data/indy/sheet.toml",
    )
    check = check_recording(model, log)
    assert check.ok
    assert [f.joint for f in check.findings if f.code == "joint_masses_differ"] == ["joint3"]


def test_masses_in_grams_leave_the_torques_alone(arm: RobotModel, log: Recording) -> None:
    check = check_recording(arm.with_parameters(1e3 * arm.parameters), log)
    assert check.ok
    # The size of the links says it without the log, and torques are compared with what is meant.
    assert [f.code for f in check.warnings] == ["description_units"]
    assert "mN m" in check_recording(arm, replace(log, tau=1e3 * log.tau)).errors[0].message
