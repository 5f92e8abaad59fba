"""Gains and channels from recordings, held or streamed, by one preparation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.description import LinkInertia, load_robot
from asbuilt.dynamics import DriveSet, PositionServo, inverse_dynamics
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    ReadingOptions,
    Recording,
    RecordingStream,
    SignalChain,
    VirtualRobot,
    prepare_samples,
    resolve_chain,
)
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.identification import identify_gains, identify_two_channels
from asbuilt.workflow import ChannelOptions, GainOptions, find_gains, identify_channels
from asbuilt.writers import gains_document, gains_text

ARM, RATE = "ur10e", 200.0
TOOL = LinkInertia.from_com(5.0, [0.0, 0.0, 0.1], 0.02 * np.eye(3))
GAINS = np.array([2.0, 0.5, 1.5, 1.0, 0.8, 1.2])


def recorded(seed: int, *, loaded: bool = False) -> Recording:
    """Return a recording whose torques are in units of which `GAINS` make N m."""
    model = load_robot(ARM)
    robot = VirtualRobot.preset("ideal", model, engine="inverse-dynamics")
    robot = robot.with_tool(TOOL) if loaded else robot
    motion = random_fourier(model, rng=seed, duration=20.0, n_harmonics=6)
    log = robot.record(motion, rate=RATE, rng=seed).recording
    return replace(log, tau=log.tau / GAINS, torque_source="current", source=f"run {seed}")


@pytest.fixture(scope="module")
def bare() -> Recording:
    return recorded(1)


@pytest.fixture(scope="module")
def loaded() -> Recording:
    return recorded(2, loaded=True)


@pytest.mark.study
def test_gains_are_those_of_samples_prepared_by_one_chain(
    bare: Recording, loaded: Recording
) -> None:
    model, drive = load_robot(ARM), DriveSet.parse("viscous,coulomb,offset")
    found = find_gains(ARM, bare, loaded, mass=5.0, options=GainOptions(drive=drive))
    chain = resolve_chain(SignalChain(), bare, loaded)
    by_hand = identify_gains(
        model,
        [prepare_samples(bare, chain)],
        [prepare_samples(loaded, chain)],
        mass=5.0,
        drive=drive,
    )
    np.testing.assert_array_equal(found.gains, by_hand.gains)
    np.testing.assert_allclose(found.gains, GAINS, rtol=0.1)


@pytest.mark.study
def test_gains_of_streams_are_those_of_the_whole(
    bare: Recording, loaded: Recording, tmp_path: Path
) -> None:
    options = GainOptions(drive=DriveSet.parse("viscous,coulomb,offset"))
    streams = []
    for name, log in (("bare", bare), ("loaded", loaded)):
        columns = {"t": log.t}
        columns |= {f"q_{k}": log.q[:, k] for k in range(6)}
        columns |= {f"tau_{k}": log.tau[:, k] for k in range(6)}
        pl.DataFrame(columns).write_parquet(tmp_path / f"{name}.parquet")
        streams.append(
            RecordingStream(
                tmp_path / f"{name}.parquet",
                load_robot(ARM),
                ReadingOptions(torque_source="current"),
                chunk_samples=1500,
            )
        )
    whole = find_gains(ARM, bare, loaded, mass=5.0, options=options)
    streamed = find_gains(ARM, *streams, mass=5.0, options=options)
    np.testing.assert_allclose(streamed.gains, whole.gains, rtol=0.02)


def test_channels_are_those_of_samples_prepared_by_one_chain(bare: Recording) -> None:
    model = load_robot(ARM)
    qd = np.gradient(bare.q, bare.t, axis=0)
    sensor = replace(bare, tau=bare.tau * GAINS, torque_source="sensor")
    motor = replace(sensor, tau=sensor.tau + 0.5 * qd + np.sign(qd), torque_source="motor")
    found = identify_channels(ARM, sensor, motor, options=ChannelOptions(checked=False))
    chain = resolve_chain(SignalChain(), sensor)
    by_hand = identify_two_channels(
        model, *([prepare_samples(log, chain)] for log in (sensor, motor))
    )
    np.testing.assert_array_equal(found.values, by_hand.values)
    assert found.values[found.names.index("Fvm2")] == pytest.approx(0.5, abs=0.05)
    with pytest.raises(UsageError, match="both channels"):
        identify_channels(ARM, [sensor, replace(sensor, tau=1.01 * sensor.tau)], motor)


@pytest.mark.study
def test_channels_whose_rows_repeat_at_different_instants_run_together() -> None:
    model = load_robot("ur10e")
    trajectory = random_fourier(model, 3, duration=20.0).sample(200.0)
    rng = np.random.default_rng(3)
    base = inverse_dynamics(model, trajectory.q, trajectory.qd, trajectory.qdd)
    held = {
        "q": trajectory.q.copy(),
        "a": base + rng.normal(size=base.shape),
        "b": 1.1 * base + 0.3,
    }
    for name in ("a", "b"):
        rows = np.flatnonzero(rng.random(len(base)) < 0.3)
        for row in rows[rows > 0]:
            held[name][row] = held[name][row - 1]
            held["q"][row] = held["q"][row - 1]
    sensor, motor = (
        Recording(
            t=trajectory.t,
            q=held["q"],
            tau=held[name],
            joint_names=model.joint_names,
            torque_source=source,
            source=f"{name}.csv",
        )
        for name, source in (("a", "sensor"), ("b", "motor"))
    )
    found = identify_channels(model, sensor, motor)
    loaded = found.scale_errors < 0.02
    assert np.any(loaded)
    np.testing.assert_allclose(found.scales[loaded], 1.1, atol=0.06)
    with pytest.raises(UsageError, match="not of the same motion"):
        identify_channels(model, sensor, replace(motor, q=motor.q[::-1]))
    with pytest.raises(UsageError, match="not of the same instants"):
        identify_channels(model, sensor, replace(motor, t=motor.t + 0.0021))


@pytest.mark.study
def test_stiffness_of_servos_from_a_payload(tmp_path: Path) -> None:
    model = load_robot("so-101")
    body = LinkInertia.from_com(0.2, [0.0, 0.0, 0.03], 1e-5 * np.eye(3))
    logs = []
    for seed in (1, 2):
        robot = VirtualRobot.preset("servo", model, rng=7)
        robot = robot.with_tool(body) if seed == 2 else robot
        motion = random_fourier(model, rng=seed, duration=24.0)
        logged = robot.record(motion, rate=200.0, rng=seed).recording
        unknown = PositionServo(kp=(np.nan,) * 5, kd=(np.nan,) * 5)
        logs.append(drive_by_command(replace(logged, servo=None), unknown))
    true = VirtualRobot.preset("servo", model, rng=7).record(
        random_fourier(model, rng=1, duration=5.0), rate=200.0, rng=1
    )
    assert true.recording.servo is not None
    stiffness = np.array(true.recording.servo.kp)
    options = GainOptions(com=(0.0, 0.0, 0.03))
    found = find_gains(model, logs[0], logs[1], mass=0.2, options=options)
    assert found.of_command
    assert found.determined[1:4].all()
    error = np.abs(found.gains - stiffness)[1:4]
    assert np.all(error < 0.02 * stiffness[1:4])
    assert np.all(error < 4.0 * found.std_errors[1:4])
    document = gains_document(found)
    assert document["option"].startswith("--kp=")
    assert document["sheet"].startswith("kp = [")
    assert "kp [N m/rad]" in gains_text(found)
