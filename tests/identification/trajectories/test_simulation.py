"""Simulated windows: closed form, MuJoCo's own actuators, and one engine against the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.identification.trajectories.arms import SERVO, recorded_by_mujoco, servo_arm

from asbuilt.arrays import Array
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.dynamics import DriveSet, PositionServo, find_base_parameters
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Samples
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.sensitivity import Trajectories
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    SimulatedRobot,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import Windows, cut_windows

pytest.importorskip("mujoco")
assert format_mjcf


def samples_of(recording, qd: Array | None = None) -> Samples:
    qd = recording.qd if qd is None else qd
    zero = np.zeros_like(recording.q)
    return Samples(
        recording.t,
        recording.q,
        qd,
        zero,
        zero,
        rate=recording.rate,
        joint_names=recording.joint_names,
    )


@pytest.fixture(scope="module")
def windows() -> Windows:
    recording = recorded_by_mujoco(servo_arm(), SERVO, duration=6.0)
    return cut_windows(recording, samples_of(recording), 0.5)


def test_windows_follow_one_another_within_segments() -> None:
    recording = recorded_by_mujoco(servo_arm(), SERVO, duration=3.0)
    whole = samples_of(recording)
    parts = replace(whole, segments=((0, 120), (130, 300)))
    cut = cut_windows(recording, parts, 0.5)
    assert (cut.starts * 100).round().astype(int).tolist() == [0, 50, 130, 180, 230]
    assert cut.q.shape == (5, 50, 2)
    with pytest.raises(RecordingError, match="no segment is as long"):
        cut_windows(recording, parts, 2.0)
    with pytest.raises(UsageError, match="needs 3"):
        cut_windows(recording, parts, 0.01)


def test_mean_of_a_held_command_is_exact_and_continuous_in_the_delay() -> None:
    t = np.arange(0.0, 1.0, 0.01)
    signal = DriveSignal("command", t, np.floor(t * 20)[:, None])
    fine = np.arange(0.2, 0.3, 1e-6)
    held = np.floor(np.floor(fine * 100 + 1e-6) / 100 * 20 + 1e-9)
    means = signal.means(np.array([0.2]), 10, 0.01)[0, :, 0]
    assert means == pytest.approx(held.reshape(10, -1).mean(axis=1), abs=1e-9)
    ahead, back = (signal.means(np.array([0.2]), 40, 0.0025, d) for d in (0.0031, 0.0029))
    slope = signal.slopes(np.array([0.2]), 40, 0.0025, 0.003)
    assert slope == pytest.approx((ahead - back) / 2e-4, abs=1e-6)


def test_rollout_reproduces_position_actuators_of_mjcf(windows: Windows) -> None:
    """MuJoCo's position actuators, clipped and delayed, from exported MJCF text."""
    simulated = simulate_windows(build_robot_as_described(servo_arm(), SERVO), windows)
    assert simulated == pytest.approx(windows.q, abs=2e-5)


def test_rollout_has_the_deadband_and_the_limit_that_falls_with_speed() -> None:
    servo = replace(SERVO, torque_limit=(8.0, 3.0), deadband=(0.02, 0.01), no_load_speed=(6.0, 9.0))
    recording = recorded_by_mujoco(servo_arm(), servo, duration=4.0)
    windows = cut_windows(recording, samples_of(recording), 0.5)
    robot = build_robot_as_described(servo_arm(), servo)
    assert simulate_windows(robot, windows) == pytest.approx(windows.q, abs=2e-5)
    plain = build_robot_as_described(servo_arm(), SERVO)
    assert np.abs(simulate_windows(plain, windows) - windows.q).max() > 5e-3
    smooth = replace(robot, values=robot.values * [1.0, 1.0, 0.0])
    base = find_base_parameters(smooth.model, smooth.drive)
    own = Trajectories(smooth.model, base).simulate(smooth, windows, smooth.model.parameters)
    assert np.any(own.state > 2.0), "the servo must be at its limit somewhere"
    assert own.sampled(windows.divisions) == pytest.approx(
        simulate_windows(smooth, windows), abs=1e-12
    )


def test_rollout_has_the_lead_of_a_derivative_of_the_control_error() -> None:
    servo = replace(SERVO, torque_limit=(8.0, 3.0), lead=(0.03, 0.02))
    recording = recorded_by_mujoco(servo_arm(), servo, duration=4.0)
    windows = cut_windows(recording, samples_of(recording), 0.5)
    robot = build_robot_as_described(servo_arm(), servo)
    assert simulate_windows(robot, windows) == pytest.approx(windows.q, abs=2e-5)
    plain = build_robot_as_described(servo_arm(), replace(servo, lead=(0.0, 0.0)))
    assert np.abs(simulate_windows(plain, windows) - windows.q).max() > 5e-3


def test_both_engines_agree_to_rounding_without_dry_friction(windows: Windows) -> None:
    robot = build_robot_as_described(servo_arm(), SERVO)
    robot = replace(robot, values=robot.values * [1.0, 1.0, 0.0])
    base = find_base_parameters(robot.model, robot.drive)
    own = Trajectories(robot.model, base).simulate(robot, windows, robot.model.parameters)
    assert own.sampled(windows.divisions) == pytest.approx(
        simulate_windows(robot, windows), abs=1e-12
    )


def test_both_engines_agree_under_dry_friction(windows: Windows) -> None:
    robot = build_robot_as_described(servo_arm(), SERVO)
    base = find_base_parameters(robot.model, robot.drive)
    own = Trajectories(robot.model, base).simulate(robot, windows, robot.model.parameters)
    assert np.any(own.state == 0.0), "some joint must be held by friction"
    assert own.sampled(windows.divisions) == pytest.approx(
        simulate_windows(robot, windows), abs=1e-4
    )


@pytest.mark.parametrize("engine", ["mujoco", "own"])
def test_pendulum_under_torque_and_stribeck_friction(engine: str) -> None:
    """The equation of motion by SciPy's integrator, friction smooth in it."""
    from asbuilt.description import bundled_robot

    model = bundled_robot("two-link").locked(["joint_2"])
    chi = model.parameters
    torque = lambda t: 3.0 * np.sin(2.0 * t) + 4.0  # noqa: E731
    drive = DriveSet.parse("viscous,coulomb,stribeck:velocity=0.2,offset")
    values = np.array([[0.3, 0.4, 0.3, 0.1]])

    def rate(t: float, x: Array) -> list[float]:
        from asbuilt.dynamics import inverse_dynamics, mass_matrix

        sign = np.tanh(x[1] / 1e-4)
        friction = 0.3 * x[1] + 0.4 * sign + 0.3 * sign * np.exp(-((x[1] / 0.2) ** 2)) + 0.1
        still = inverse_dynamics(model, x[:1], np.zeros(1), np.zeros(1))
        return [x[1], float((torque(t) - friction - still[0]) / mass_matrix(model, x[:1])[0, 0])]

    t = np.arange(0.0, 0.5, 0.01)
    x = solve_ivp(rate, (0, 0.5), [0.3, 1.0], t_eval=t, method="LSODA", rtol=1e-8, atol=1e-10).y
    windows = Windows(
        "pendulum",
        0.5,
        100.0,
        np.zeros(1),
        x[0][None, :, None],
        np.array([[0.3]]),
        np.array([[1.0]]),
        DriveSignal("torque", np.linspace(0, 1, 2001), torque(np.linspace(0, 1, 2001))[:, None]),
        longest_step=2e-4,
    )
    robot = SimulatedRobot(model, drive, values)
    if engine == "mujoco":
        q = simulate_windows(robot, windows)
    else:
        trajectories = Trajectories(model, find_base_parameters(model, drive))
        q = trajectories.simulate(robot, windows, chi).sampled(windows.divisions)
    assert np.ptp(windows.q) > 0.1
    assert q == pytest.approx(windows.q, abs=5e-4)


def test_divergence_is_reported_as_missing_numbers(windows: Windows) -> None:
    unstable = PositionServo(kp=(40.0, 25.0), kd=(0.0, 0.0), delay=0.0)
    robot = build_robot_as_described(servo_arm(), unstable)
    robot = replace(robot, values=robot.values * [1.0, -60.0, 0.0])
    simulated = simulate_windows(robot, windows)
    assert np.all(np.isfinite(simulated[:, 0]))
    assert np.all(np.isnan(simulated[:, -1]))


@pytest.mark.parametrize("engine", ["mujoco", "own"])
def test_centred_steps_of_a_joint_have_errors_of_second_order(engine: str) -> None:
    """The limit is that of raw steps of 10 and 20 us; Coriolis forces are not centred."""
    servo = PositionServo(kp=(40.0,), kd=(1.0,), delay=0.006)
    robot = build_robot_as_described(servo_arm().locked(["joint_2"]), servo)
    robot = replace(robot, values=robot.values * [1.0, 1.0, 0.0])
    trajectories = Trajectories(robot.model, find_base_parameters(robot.model, robot.drive))
    t, q, qd = np.arange(0.0, 2.0, 0.01), np.array([[0.2]]), np.array([[0.7]])
    signal = DriveSignal("command", t, 0.5 * np.sin(6.0 * t)[:, None])
    cut = Windows("joint", 0.5, 100.0, np.array([0.4]), np.zeros((1, 50, 1)), q, qd, signal)

    def moved(step: float, *, centred: bool) -> Array:
        fine = replace(cut, longest_step=step)
        stepped = robot.centred(fine.step) if centred else robot
        if engine == "mujoco":
            return simulate_windows(stepped, fine)
        motion = trajectories.simulate(stepped, fine, robot.model.parameters)
        if centred:
            before = fine.start_qd - 0.5 * fine.step * motion.a[:, 0]
            fine = replace(fine, start_qd=before)
            motion = trajectories.simulate(stepped, fine, robot.model.parameters)
        return motion.sampled(fine.divisions)

    limit = 2.0 * moved(1e-5, centred=False) - moved(2e-5, centred=False)
    coarse, fine = (np.abs(moved(h, centred=True) - limit).max() for h in (1e-3, 5e-4))
    assert coarse < 0.05 * np.abs(moved(1e-3, centred=False) - limit).max()
    assert 3.0 < coarse / fine < 5.0
