"""Wrong commands are named: unit, order, sign, clock, zero; right ones are no finding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import bundled_robot, load_robot
from asbuilt.dynamics import PositionServo
from asbuilt.excitation import random_fourier
from asbuilt.experiment import ReadingOptions, Recording, check_recording, read_fitted_recordings
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.quality.command_checks import EXPLAINED, check_commands

SHARED = Path(__file__).parents[4] / "shared"
MODEL = bundled_robot("so-101")
RATE = 100.0
SERVO = PositionServo(kp=(17.8,) * 5, kd=(0.0,) * 5, torque_limit=(3.35,) * 5)


@pytest.fixture(scope="module")
def log() -> Recording:
    """Return motions that follow their commands by 80 ms, with some noise and no dynamics."""
    t = np.arange(0.0, 20.0, 1.0 / RATE)
    motion = random_fourier(MODEL, rng=4, duration=20.0)
    u = motion.at(t)[0]
    q = np.column_stack([np.interp(t - 0.08, t, u[:, k]) for k in range(5)])
    q += np.random.default_rng(1).normal(scale=1e-3, size=q.shape)
    raw = Recording(t=t, q=q, tau=np.zeros_like(q), command=u, joint_names=MODEL.joint_names)
    return drive_by_command(raw, SERVO)


def shifted(seconds: float) -> Callable[[Array], Array]:
    def move(u: Array) -> Array:
        rows = np.arange(len(u)) - round(seconds * RATE)
        return np.asarray(u[np.clip(rows, 0, len(u) - 1)])

    return move


WRONG: dict[str, tuple[Callable[[Array], Array], str, str]] = {
    "degrees": (np.degrees, "command_units", "as if commands were in deg"),
    "counts": (lambda u: 2048.0 + u * 2048.0 / np.pi, "command_units", "counts of 4096"),
    "order": (lambda u: u[:, [0, 2, 1, 3, 4]], "command_swapped", "elbow_flex the command of"),
    "late": (shifted(0.5), "command_clock", "precede their commands by 0.42 s"),
    "early": (shifted(-0.5), "command_clock", "follow their commands 0.58 s later"),
    "held": (lambda u: 0.0 * u, "command_constant", "are constant, though the joints move"),
    "sign": (lambda u: u * [1, -1, 1, 1, 1], "command_flipped", "shoulder_lift moves against"),
    "zero": (
        lambda u: u + np.array([0, 0.3, 0, 0, 0]),
        "command_offset",
        "shoulder_lift is mostly 0.3",
    ),
    "speed": (lambda u: np.gradient(u, axis=0) * RATE, "command_not_followed", "does not follow"),
}


@pytest.mark.parametrize("case", WRONG)
def test_one_finding_names_what_is_wrong_with_the_commands(log: Recording, case: str) -> None:
    wrong, code, said = WRONG[case]
    assert log.command is not None
    check = check_recording(MODEL, replace(log, command=wrong(log.command)))
    of_commands = [f for f in check.findings if f.code.startswith("command_")]
    assert {each.code for each in of_commands} == {code}
    assert said in of_commands[0].message
    assert not set(check.codes) & set(EXPLAINED)


def test_one_joint_in_degrees_is_named(log: Recording) -> None:
    assert log.command is not None
    command = log.command * [1, 1, 1, 1, 57.3]
    (finding,) = check_commands(MODEL, replace(log, command=command))
    assert finding.joint == "wrist_roll"
    assert "convert the commands" in str(finding.cure)


def test_positions_logged_as_commands_are_named(log: Recording) -> None:
    for command in (log.q, np.vstack([log.q[1:], log.q[-1:]])):
        (finding,) = check_commands(MODEL, replace(log, command=command))
        assert finding.code == "command_is_position"


def test_missing_commands_are_named_and_not_the_torques(log: Recording) -> None:
    assert log.command is not None
    command = log.command.copy()
    command[500:503, 1] = np.nan
    gap = drive_by_command(replace(log, command=command), SERVO)
    check = check_recording(MODEL, gap)
    (finding,) = [each for each in check.findings if each.code == "not_finite"]
    assert "3 of 2000 values of the command of shoulder_lift" in finding.message


def test_right_commands_are_no_finding(log: Recording) -> None:
    assert not list(check_commands(MODEL, log))
    assert not list(check_commands(MODEL, replace(log, servo=None)))


def test_commands_of_real_robots_are_no_finding() -> None:
    data, models = SHARED / "data", SHARED / "models"
    if not data.is_dir():
        pytest.skip("shared data are absent")
    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    options = ReadingOptions(
        torque_source="command", sheet={"joints": dict(zip(names, joints, strict=True))}
    )
    arm = replace(options, lock="gripper=0")
    dog = ReadingOptions(torque_source="command", kp=20.0, kd=1.5)
    so101 = load_robot(models / "so101" / "so101_new_calib.xml")
    go2 = load_robot(models / "go2" / "go2.xml", fixed_base=True)
    motions = ("velocity_ramp", "friction_gravity", "prbs_excitation", "hold_under_gravity")
    logs = [(so101, data / "so101_sage" / each, arm) for each in motions]
    for model, path, chosen in [*logs, (go2, data / "go2_hung" / "traj_0.pt", dog)]:
        robot, ((log,),) = read_fitted_recordings(model, [[path]], chosen)
        assert isinstance(log, Recording)
        assert not list(check_commands(robot, log))
