"""Torque of a position servo against MuJoCo's position actuator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from asbuilt.dynamics import PositionServo
from asbuilt.experiment import Recording, SignalChain, prepare_samples
from asbuilt.experiment.command.torque import (
    drive_by_command,
    drop_saturated,
    estimate_direction_speeds,
    find_saturated,
    hold_command,
)

PERIOD, STEP = 0.01, 0.001
ROBOT = """
<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body><joint name="j" axis="0 1 0" damping="0.2" armature="0.02"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/></body></worldbody>
<actuator><position joint="j" kp="15" kv="0.4"/></actuator></mujoco>
"""


def simulated(delay_steps: int = 0):
    """Return a recording at 100 Hz, and the torque in the middle of every time step."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ROBOT)
    data, per = mujoco.MjData(model), round(PERIOD / STEP)
    n = 2000
    t = PERIOD * np.arange(n)
    u = 0.5 * np.sin(2.0 * t) + 0.2 * np.sin(7.0 * t)
    q, torque, late = np.empty(n), np.empty((n, per)), np.repeat(u, per)
    late = np.concatenate([np.full(delay_steps, u[0]), late])
    for k in range(n):
        q[k] = data.qpos[0]
        for i in range(per):
            data.ctrl[0] = late[k * per + i]
            before = data.qpos[0], data.qvel[0]
            mujoco.mj_step(model, data)
            at, speed = 0.5 * (before[0] + data.qpos[0]), 0.5 * (before[1] + data.qvel[0])
            torque[k, i] = 15.0 * (data.ctrl[0] - at) - 0.4 * speed
    recording = Recording(
        t=t, q=q[:, None], tau=np.zeros((n, 1)), command=u[:, None], joint_names=("j",)
    )
    return recording, torque.ravel()


@pytest.mark.parametrize("delay_steps", [0, 13])
def test_torque_of_a_held_and_late_command_is_that_of_the_actuator(delay_steps):
    recording, truth = simulated(delay_steps)
    servo = PositionServo(kp=(15.0,), kd=(0.4,), delay=STEP * delay_steps)
    chain = SignalChain(cutoff=5.0)
    driven = prepare_samples(drive_by_command(recording, servo), chain)
    fine = Recording(
        t=STEP * (np.arange(truth.size) + 0.5),
        q=np.interp(STEP * np.arange(truth.size), recording.t, recording.q[:, 0])[:, None],
        tau=truth[:, None],
    )
    expected = prepare_samples(fine, SignalChain(cutoff=5.0))
    known = CubicSpline(expected.filtered_times, expected.filtered_torque[:, 0])(
        driven.filtered_times
    )
    error = driven.filtered_torque[:, 0] - known
    inside = slice(20, -20)
    assert np.std(error[inside]) < 0.01 * np.std(known)
    early = prepare_samples(
        drive_by_command(recording, PositionServo(kp=(15.0,), kd=(0.4,), delay=-PERIOD / 2)),
        chain,
    )
    assert np.std((early.filtered_torque[:, 0] - known)[inside]) > 3.0 * np.std(error[inside])


def test_rate_is_the_derivative_of_the_held_command():
    t = np.arange(0.0, 4.0, 0.01)
    u = np.sin(3.0 * t)[:, None]
    recording = Recording(t=t, q=u, tau=u, command=u)
    ahead, behind = (hold_command(recording, delay) for delay in (-1e-4, 1e-4))
    numeric = (ahead - behind) / 2e-4
    assert hold_command(recording, derivative=1)[5:-5] == pytest.approx(numeric[5:-5], abs=1e-6)


def test_a_lead_adds_the_rate_of_what_acts():
    t = np.arange(0.0, 4.0, 0.01)
    u = np.sin(3.0 * t)[:, None]
    servo = PositionServo(kp=(10.0,), kd=(0.0,), lead=(0.04,), delay=0.007)
    recording = Recording(t=t, q=0.0 * u, tau=u, command=u, servo=servo)
    at = t - 0.5 * 0.01 - servo.delay
    expected = np.sinc(3.0 * 0.01 / (2.0 * np.pi)) * (np.sin(3.0 * at) + 0.12 * np.cos(3.0 * at))
    inside = slice(20, -20)
    held = hold_command(recording, servo.delay)
    assert held[inside, 0] == pytest.approx(expected[inside], abs=1e-6)
    assert drive_by_command(recording, servo).tau == pytest.approx(10.0 * held)
    numeric = (hold_command(recording, 0.0069) - hold_command(recording, 0.0071)) / 2e-4
    assert hold_command(recording, 0.007, derivative=1)[inside] == pytest.approx(
        numeric[inside], abs=1e-4
    )


def test_an_unknown_stiffness_counts_as_one_and_logged_torques_are_kept():
    t = np.arange(0.0, 1.0, 0.01)
    x = t[:, None]
    recording = Recording(t=t, q=x, tau=x + 1.0, command=x + 0.5)
    driven = drive_by_command(recording, PositionServo(kp=(np.nan,), kd=(np.nan,)))
    assert driven.torque_source == "command"
    assert driven.tau[50, 0] == pytest.approx(0.5 - 0.005)
    assert driven.extra["tau_logged"][:, 0] == pytest.approx(t + 1.0)


def test_samples_at_the_torque_limit_are_left_out():
    t = np.arange(0.0, 20.0, 0.01)
    q = np.sin(t)[:, None]
    command = q + np.where((t > 8.0) & (t < 9.0), 1.0, 0.1)[:, None]
    servo = PositionServo(kp=(10.0,), kd=(0.0,), torque_limit=(5.0,))
    recording = drive_by_command(Recording(t=t, q=q, tau=q, command=command), servo)
    assert np.abs(recording.tau).max() == 5.0
    limited = t[find_saturated(recording)[:, 0]]
    assert (limited.min(), limited.max()) == pytest.approx((8.0, 9.0), abs=0.05)
    left = drop_saturated(prepare_samples(recording), recording)
    assert not np.any((left.t > 8.05) & (left.t < 8.95))
    assert len(left.segments) == 2


def test_direction_is_unknown_below_half_a_step_of_the_encoder_in_a_period():
    t = np.arange(0.0, 10.0, 0.01)
    rng = np.random.default_rng(1)
    exact = 0.3 * np.sin(t) + 1e-9 * rng.normal(size=t.size)
    step = 2.0 * np.pi / 4096
    q = np.column_stack([np.round(exact / step) * step, exact])
    coarse, fine = estimate_direction_speeds(Recording(t=t, q=q, tau=q), cutoff=8.0)
    assert coarse == pytest.approx(np.pi * 8.0 * step)
    assert fine < 0.05 * coarse


@pytest.mark.parametrize("size", [1e-3, 0.24])
def test_the_limit_cuts_what_a_lead_makes_of_a_step(size):
    """The impulse of a step: all of kp lead size, or the limit for a tick, as a servo has it."""
    t = np.arange(100) * 0.02
    command = np.where(t < 1.0, 0.0, size)[:, None]
    servo = PositionServo(kp=(11.5,), kd=(0.0,), lead=(0.024,), torque_limit=(4.3,))
    log = Recording(t=t, q=0.0 * command, tau=0.0 * command, command=command, servo=servo)
    plain = replace(log, servo=replace(servo, lead=(0.0,)))
    impulse = 11.5 * float(np.sum(hold_command(log) - hold_command(plain))) * 0.02
    pulse = np.clip(11.5 * 0.024 * size / 1e-3, -4.3, 4.3) * 1e-3
    assert impulse == pytest.approx(pulse, rel=1e-6)
