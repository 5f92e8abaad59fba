"""A virtual robot with position servos moves as their law says, and logs what servos log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import PositionServo
from asbuilt.errors import UsageError
from asbuilt.excitation import Trajectory, random_fourier
from asbuilt.experiment import (
    SignalChain,
    VirtualRobot,
    prepare_samples,
    read_recording,
    with_settings,
)
from asbuilt.experiment.virtual.drive_train import JointServo
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import SimulatedRobot
from asbuilt.identification.trajectories.windows import cut_windows
from asbuilt.writers import write_simulation

ROBOTS = ("so-101", "go2", "g1-arms")


@pytest.mark.parametrize("name", ROBOTS)
def test_the_truth_rolls_out_to_what_was_logged(name: str) -> None:
    """The rollout integrates the same law by other steps, with MuJoCo's own actuators."""
    model = bundled_robot(name)
    robot = VirtualRobot.preset("servo", model, rng=1)
    motion = random_fourier(model, 2, duration=4.0, n_harmonics=4)
    simulated = robot.record(motion, rng=3)
    assert isinstance(robot.controller, JointServo)
    gains = robot.controller.law(model)
    known = PositionServo(
        kp=gains.kp, kd=gains.kd, torque_limit=gains.torque_limit, delay=robot.controller.delay
    )
    samples = prepare_samples(simulated.recording, SignalChain(cutoff=20.0, rests=True))
    windows = cut_windows(simulated.recording, samples, 0.5)
    values = robot.drive_values.reshape(model.n_joints, -1)
    true = SimulatedRobot(simulated.model, robot.drive, values, known)
    error = np.sqrt(np.mean((simulate_windows(true, windows) - windows.q) ** 2))
    early = replace(true, servo=PositionServo(kp=known.kp, kd=known.kd, delay=0.0))
    assert error < 4e-4
    assert np.sqrt(np.mean((simulate_windows(early, windows) - windows.q) ** 2)) > 2.0 * error


@pytest.mark.parametrize("name", ROBOTS)
def test_the_log_has_commands_and_gains_and_no_torque(name: str, tmp_path: Path) -> None:
    model = bundled_robot(name)
    simulated = VirtualRobot.preset("servo", model, rng=1).record(
        random_fourier(model, 2, duration=2.0, n_harmonics=4), rng=3
    )
    files = write_simulation(tmp_path / "log.csv", simulated)
    header = files["recording"].read_text().splitlines()[0]
    assert "tau" not in header
    read = read_recording(files["recording"], model=model)
    assert (read.torque_source, read.joint_names) == ("command", model.joint_names)
    for logged in (read.command, simulated.recording.command):
        assert logged is not None
    np.testing.assert_array_equal(read.command, simulated.recording.command)
    assert read.servo is not None
    assert read.servo.kp == tuple(joint.drive.kp for joint in model.joints)
    assert read.servo.torque_limit == tuple(joint.limits.torque for joint in model.joints)
    assert read.servo.delay is None


def test_a_command_is_held_and_arrives_late() -> None:
    ticks = np.arange(0.0, 0.1, 0.001)
    ramp = Trajectory(ticks, ticks[:, None], np.ones((100, 1)), np.zeros((100, 1)))
    target = JointServo(kp=1.0, delay=0.005).target(ramp, 50.0)
    expected = 0.02 * np.floor(np.maximum(ticks - 0.005, 0.0) / 0.02 + 1e-9)
    np.testing.assert_allclose(target.q[:, 0], expected, atol=1e-12)
    assert not np.any(target.qd)


def test_settings_of_servos_and_controllers_are_kept_apart() -> None:
    model = bundled_robot("two-link")
    servo = VirtualRobot.preset("servo", model, rng=1)
    changed = with_settings(servo, ["kp=30,20", "delay=0.002"]).controller
    assert isinstance(changed, JointServo)
    assert (changed.kp, changed.delay) == ((30.0, 20.0), 0.002)
    with pytest.raises(UsageError, match="belongs to a controller"):
        with_settings(servo, ["bandwidth=5"])
    with pytest.raises(UsageError, match="belongs to a servo"):
        with_settings(VirtualRobot.preset("lab", model), ["kp=5"])


@pytest.mark.parametrize("values", [{"kp": 0.0}, {"kp": (1.0, -1.0)}, {"kp": 1.0, "delay": -1.0}])
def test_impossible_servos_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        JointServo(**values)
