"""Replays against MuJoCo, and what they take away against averages over noise."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import DriveValues
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import DriveSet, PositionServo, find_base_parameters
from asbuilt.experiment import Recording, SignalChain, prepare_samples, resolve_chain
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.servo.servo_estimate import estimate_servo
from asbuilt.identification.servo.servo_replay import (
    estimate_position_noise,
    replay,
    replay_recording,
)
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import Windows

pytest.importorskip("mujoco")
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows

RATE, DURATION, DELAY, FINE = 100.0, 30.0, 0.006, 2e-5
DRIVE = DriveSet.parse("armature,viscous,coulomb")
DRIVES = DriveValues(armature=0.02, viscous=0.4, coulomb=0.08)
SERVO = PositionServo(kp=(20.0,) * 3, kd=(1.5,) * 3, delay=DELAY)
LEG = """<mujoco model="leg"><worldbody><body name="hip"><joint name="hip" axis="1 0 0"/>
<geom type="capsule" size="0.04" fromto="0 0 0 0 0.09 0" mass="0.7"/>
<body name="thigh" pos="0 0.09 0"><joint name="thigh" axis="0 1 0"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="1.1"/>
<body name="calf" pos="0 0 -0.2"><joint name="calf" axis="0 1 0"/>
<geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.2" mass="0.25"/></body></body></body>
</worldbody></mujoco>"""


def leg():
    model = read_mjcf(LEG)
    return replace(model, joints=tuple(replace(joint, drive=DRIVES) for joint in model.joints))


def values(model):
    drives = [[j.drive.armature, j.drive.viscous, j.drive.coulomb] for j in model.joints]
    return np.append(model.parameters, np.ravel(drives))


def command(t):
    rng = np.random.default_rng(0)
    u = np.zeros((t.size, 3))
    for f in (0.31, 0.57, 0.93, 1.7):
        size, phase = rng.uniform(0.05, 0.25, 3) / np.sqrt(f), rng.uniform(0.0, 6.28, 3)
        u += size * np.sin(2.0 * np.pi * f * t[:, None] + phase)
    return u


@pytest.fixture(scope="module")
def exact():
    """Return a recording without noise, by MuJoCo in steps of 20 us."""
    model, t = leg(), np.arange(round(DURATION * RATE)) / RATE
    u = command(t)
    window = Windows(
        "virtual",
        float(t[-1]),
        RATE,
        t[:1],
        u[None],
        u[:1],
        np.zeros_like(u[:1]),
        DriveSignal("command", t, u),
        longest_step=FINE,
    )
    q = simulate_windows(build_robot_as_described(model, SERVO), window)[0]
    recording = Recording(
        t=t, q=q, tau=np.zeros_like(q), command=u, joint_names=model.joint_names, source="virtual"
    )
    return model, recording


@pytest.mark.study
def test_a_replay_is_the_motion_that_mujoco_simulates_in_fine_steps(exact):
    model, recording = exact
    base = find_base_parameters(model, DRIVE)
    parameters = values(model)
    q = replay_recording(model, base, recording, SERVO, parameters)
    late = replay_recording(model, base, recording, replace(SERVO, delay=DELAY + 2e-4), parameters)
    off = np.abs(q - recording.q)
    assert np.sqrt(np.mean(off**2)) < 0.1 * np.sqrt(np.mean((late - recording.q) ** 2))


@pytest.mark.study
def test_episodes_of_one_log_are_replayed_one_by_one(exact):
    """Positions and commands jump at the gap between two episodes, and the robot did not."""
    model, recording = exact
    order = np.r_[1500:3000, 0:1500]
    t = recording.t + np.where(np.arange(3000) < 1500, 0.0, 10.0)
    q, u = recording.q[order], recording.command[order]
    assert np.abs(q[1500] - q[1499]).max() > 0.05
    joined = replace(recording, t=t, q=q, command=u)
    base = find_base_parameters(model, DRIVE)
    off = np.abs(replay_recording(model, base, joined, SERVO, values(model)) - q)
    assert np.sqrt(np.mean(off[1550:] ** 2)) < 1e-4
    noise = 1e-3 * np.random.default_rng(0).standard_normal(q.shape)
    assert estimate_position_noise(replace(joined, q=q + noise)) == pytest.approx(
        [1e-3] * 3, rel=0.1
    )
    driven = drive_by_command(joined, replace(SERVO, delay=None))
    found = estimate_servo(model, [driven], DRIVE, resolve_chain(SignalChain(), driven))
    assert abs(found.servo.delay - DELAY) < 4.0 * found.errors.delay + 1e-4


@pytest.mark.study
def test_a_replay_that_diverges_is_none(exact):
    model, recording = exact
    base = find_base_parameters(model, DRIVE)
    parameters = np.append(model.parameters, np.tile([0.02, -50.0, 0.0], 3))
    assert replay_recording(model, base, recording, SERVO, parameters) is None


@pytest.mark.study
def test_white_noise_of_the_positions_is_measured(exact):
    recording = exact[1]
    noise = np.array([1e-3, 3e-3, 2e-3])
    noisy = recording.q + noise * np.random.default_rng(0).standard_normal(recording.q.shape)
    assert estimate_position_noise(replace(recording, q=noisy)) == pytest.approx(noise, rel=0.1)
    steps = np.round(recording.q / 2e-3) * 2e-3
    assert estimate_position_noise(replace(recording, q=steps)) == pytest.approx(
        2e-3 / 12**0.5, rel=0.2
    )


@pytest.mark.study
def test_what_noise_of_the_positions_adds_on_average_is_taken_away(exact):
    model, recording = exact
    base = find_base_parameters(model, DRIVE)
    truth = base.values(values(model))
    chain, found = None, {True: [], False: []}
    noise = 4e-3 * np.random.default_rng(1).standard_normal(recording.q.shape)
    for added in (noise, -noise):
        noisy = replace(recording, q=recording.q + added)
        driven = drive_by_command(noisy, replace(SERVO, delay=None))
        chain = resolve_chain(SignalChain(), driven)
        servo = estimate_servo(model, [driven], DRIVE, chain, delay=DELAY)
        samples = [prepare_samples(drive_by_command(noisy, servo.servo), chain)]
        for corrected in (True, False):
            expected = servo.expected if corrected else None
            fit = fit_samples(model, samples, base=base, method="wls", expected=expected)
            found[corrected].append(fit.estimate.beta)
    drives = [j for j, name in enumerate(base.names) if name[:2] in ("Fv", "Ia")]
    bias = {
        key: np.abs(np.mean(each, axis=0)[drives] / truth[drives] - 1.0)
        for key, each in found.items()
    }
    assert np.max(bias[False]) > 0.02
    assert np.max(bias[True]) < 0.25 * np.max(bias[False])


@pytest.mark.study
def test_a_replay_of_a_robot_that_rests_is_none(exact):
    model, recording = exact
    base = find_base_parameters(model, DRIVE)
    stuck = np.append(model.parameters, np.tile([0.02, 0.4, 50.0], 3))
    driven = drive_by_command(recording, SERVO)
    chain = resolve_chain(SignalChain(), driven)
    assert replay(model, base, [driven], SERVO, chain, stuck) is None
