"""Joints whose log has another direction or zero than the description."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording, simulate_recording
from asbuilt.findings import Finding
from studied_cases import first_of

QUARTER = 0.5 * np.pi


def recorded(robot: str) -> Recording:
    model = bundled_robot(robot)
    return simulate_recording(model, random_fourier(model, rng=2), rate=100.0)


def changed(
    recording: Recording, k: int, *, position: float = 1.0, torque: float = 1.0, zero: float = 0.0
) -> Recording:
    """Return the log of a joint with q_log = position q + zero."""
    q, tau = np.array(recording.q), np.array(recording.tau)
    q[:, k] = position * q[:, k] + zero
    tau[:, k] *= torque
    return replace(recording, q=q, tau=tau, qd=None, qdd=None)


def found(robot: str, recording: Recording) -> Finding | None:
    check = check_recording(bundled_robot(robot), recording)
    return next((each for each in check.findings if each.code == "joint_convention"), None)


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "ur10e", "puma-560"])
def test_nothing_is_found_as_logged(robot: str) -> None:
    assert found(robot, recorded(robot)) is None


@pytest.mark.parametrize(
    ("robot", "joint", "change", "cure"),
    first_of(
        2,
        [
            ("kuka-iiwa7-r800", 3, {"position": -1.0}, "position_sign = [1, 1, 1, -1, 1, 1, 1]"),
            ("kuka-iiwa7-r800", 1, {"zero": QUARTER}, "zero = [0, 1.5708, 0, 0, 0, 0, 0]"),
            ("ur10e", 2, {"position": -1.0, "torque": -1.0}, "sign = [1, 1, -1, 1, 1, 1]"),
            ("ur10e", 1, {"zero": -QUARTER}, "zero = [0, -1.5708, 0, 0, 0, 0]"),
            (
                "puma-560",
                2,
                {"position": -1.0, "zero": np.pi},
                "position_sign = [1, 1, -1, 1, 1, 1]",
            ),
        ],
    ),
)
def test_one_joint_is_named_and_the_cure_is_the_change(
    robot: str, joint: int, change: dict[str, float], cure: str
) -> None:
    finding = found(robot, changed(recorded(robot), joint, **change))
    assert finding is not None
    assert finding.severity == "error"
    assert finding.joint == bundled_robot(robot).joint_names[joint]
    assert cure in str(finding.cure)


def test_two_joints_are_named() -> None:
    recording = changed(recorded("kuka-iiwa7-r800"), 1, position=-1.0, torque=-1.0)
    finding = found("kuka-iiwa7-r800", changed(recording, 3, zero=QUARTER))
    assert finding is not None
    assert "zero = [0, 0, 0, 1.5708, 0, 0, 0]" in str(finding.cure)
    assert "position_sign = [1, -1, 1, 1, 1, 1, 1]" in str(finding.cure)


def test_unrelated_torques_have_no_convention() -> None:
    recording = recorded("kuka-iiwa7-r800")
    torques = np.random.default_rng(4).normal(0.0, 20.0, recording.tau.shape)
    assert found("kuka-iiwa7-r800", replace(recording, tau=torques)) is None


@pytest.mark.study
def test_a_zero_that_shows_in_no_torque_is_not_named() -> None:
    """About the vertical another zero brings a joint within its limits, and no torque changes."""
    turned = changed(recorded("puma-560"), 0, zero=3.0)
    wrapped = replace(turned, notes=("positions that wrap at 6.28319 were unwrapped: j1 2 times",))
    check = check_recording(bundled_robot("puma-560"), wrapped)
    assert "joint_zero" not in {finding.code for finding in check.findings}
