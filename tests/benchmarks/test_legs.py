"""95 % intervals of robots on legs hold the bodies that MuJoCo moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from asbuilt import identify
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import read_fitted_recordings
from legged_robots import LEGGED
from legs import STEP, Walk, against_truth, described, parameter_errors, recorded, studied
from outside_robot import other_bodies

LEAST = 0.93
"""Least share of 95 % intervals with the truth."""


@pytest.mark.parametrize(("robot", "mass"), [("solo12", 2.5013), ("go2", 15.207)])
def test_robots_weigh_what_their_figures_say(robot: str, mass: float) -> None:
    model = LEGGED[robot].model()
    assert sum(link.inertia.mass for link in model.links) == pytest.approx(mass, abs=2e-3)


@pytest.mark.parametrize(
    ("robot", "motion", "radius"), [("solo12", "squat", 0.016), ("go2", "step", 0.022)]
)
def test_feet_roll_on_their_balls(robot: str, motion: str, radius: float) -> None:
    """A light robot that trots slips a little in MuJoCo, so that the Solo12 squats."""
    cad, rng = described(robot), np.random.default_rng(4)
    log = recorded(LEGGED[robot], cad, motion, 4.0, rng)
    unstated = replace(cad, contacts=tuple(replace(each, radius=None) for each in cad.contacts))
    for contact in read_fitted_recordings(unstated, [log])[0].contacts:
        assert contact.radius == pytest.approx(radius, abs=1.5e-3)


@pytest.mark.study
@pytest.mark.parametrize(
    ("robot", "motion", "method", "least"),
    [
        ("go2", "flight", "wls", LEAST),
        ("solo12", "step", "auto", 0.85),  # three robots: .92, .97, .85, as the how-to says
        ("solo12", "squat", "auto", LEAST),
    ],
)
def test_intervals_from_commands_hold_the_truth(
    robot: str, motion: str, method: str, least: float
) -> None:
    walk = Walk(robot, (motion,), method=method, command=True)
    truth, study = studied(walk, 0)
    error, std_error = against_truth(truth, study)
    assert np.mean(np.abs(error) < 1.959964 * std_error) >= least
    assert study.result.servo is not None
    assert study.result.servo.delay == pytest.approx(-STEP / 10.0, abs=1.5e-4)


@pytest.mark.study
def test_one_unknown_stiffness_follows_from_the_weight() -> None:
    """Feet that stand mix the joints; the weight by CAD, 0.4 % off, settles what all share."""
    legged, rng = LEGGED["go2"], np.random.default_rng(0)
    cad = described("go2")
    log = recorded(legged, other_bodies(cad, rng), "step", 8.0, rng, command=True)
    shared = {"torque_source": "command", "kd": (legged.kd,), "method": "wls"}
    with pytest.raises(UsageError, match="mix the joints"):
        identify(cad, log, **shared)
    servo = identify(cad, log, same_servos=True, **shared).result.servo
    assert servo is not None
    assert servo.kp[:6] == (0.0,) * 6
    assert servo.kp[6:] == pytest.approx((legged.kp,) * 12, rel=0.05)
    with pytest.raises(UsageError, match="0 at every joint"):
        identify(cad, log, kp=(0.0,), **shared)


@pytest.mark.study
@pytest.mark.parametrize(
    ("robot", "motion", "forces"),
    [
        ("solo12", "step", False),
        ("solo12", "hop", False),
        ("solo12", "flight", False),
        ("go2", "step", False),
        ("go2", "hop", False),
        ("go2", "step", True),
    ],
)
def test_intervals_hold_the_truth(robot: str, motion: str, forces: bool) -> None:
    ((error, std_error),) = parameter_errors(Walk(robot, (motion,), forces=forces), 1)
    assert np.mean(np.abs(error) < 1.959964 * std_error) >= LEAST


@pytest.mark.study
@pytest.mark.parametrize("braked", [True, False])
def test_feet_that_brake_their_turning_are_named_and_others_are_not(braked: bool) -> None:
    _, study = studied(Walk("go2", ("step",), 10.0, braked=braked), 0)
    found = [finding for finding in study.findings if finding.code == "foot_moments"]
    assert bool(found) == braked
    assert all("torsional" in finding.message for finding in found)
    reasons = list(study.verdict.reasons)
    assert ("foot_moments" in reasons) == braked


def test_four_flat_feet_leave_no_equation() -> None:
    log = recorded(LEGGED["go2"], described("go2"), "squat", 3.0, np.random.default_rng(0))
    cad = described("go2")
    flat = tuple(replace(contact, flat=True, radius=0.0) for contact in cad.contacts)
    with pytest.raises(RecordingError, match="no equation is left"):
        identify(replace(cad, contacts=flat), log, torque_source="motor")
