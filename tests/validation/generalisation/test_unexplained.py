"""Joints whose torque is not explained are named with the time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, VirtualRobot, prepare_samples
from asbuilt.findings import Finding
from asbuilt.identification import identify_samples
from asbuilt.validation import validate_samples
from asbuilt.validation.generalisation.generalisation import (
    report_nameless,
    report_unexplained,
    returning_share,
)

MODEL = bundled_robot("ur10e")


def log() -> Recording:
    machine = VirtualRobot.ideal(MODEL).with_drive(
        DriveSet.parse("viscous,coulomb"), np.tile([1.0, 2.0], 6)
    )
    found = machine.record(random_fourier(MODEL, rng=1, duration=30.0), rate=100.0).recording
    noise = np.random.default_rng(0).normal(size=found.tau.shape)
    return replace(found, tau=found.tau + 0.5 * noise, qd=None, qdd=None)


def findings(recording: Recording) -> list[Finding]:
    samples = prepare_samples(recording)
    drive = DriveSet.parse("viscous,coulomb")
    result = identify_samples(MODEL, samples, drive=drive, method="entropic")
    return list(report_unexplained([validate_samples(result, samples)]))


def test_a_right_log_is_explained() -> None:
    assert findings(log()) == []


@pytest.mark.parametrize("joint", [1, 2])
def test_a_sensor_that_fails_midway_is_named(joint: int) -> None:
    recording = log()
    tau = np.array(recording.tau)
    tau[recording.t > 18.0, joint] = 150.0
    found = {each.joint for each in findings(replace(recording, tau=tau))}
    assert found == {MODEL.joint_names[joint]}


@pytest.mark.parametrize(("joint", "torque"), [(1, 40.0), (2, -25.0)])
def test_a_contact_of_a_fraction_of_the_torque_is_named(joint: int, torque: float) -> None:
    recording = log()
    tau = np.array(recording.tau)
    tau[(recording.t > 12.0) & (recording.t < 16.0), joint] += torque
    (finding,) = findings(replace(recording, tau=tau))
    assert finding.joint == MODEL.joint_names[joint]
    assert "most of it from 1" in finding.message


def test_a_push_is_named_with_its_time() -> None:
    recording = log()
    tau = np.array(recording.tau)
    tau[(recording.t > 12.0) & (recording.t < 16.0), 2] += 150.0
    (finding,) = findings(replace(recording, tau=tau))
    assert finding.joint == "elbow_joint"
    start, stop = finding.message.rpartition("from ")[2].removesuffix(" s").split(" to ")
    assert float(start) == pytest.approx(12.0, abs=1.6)
    assert float(stop) == pytest.approx(16.0, abs=1.6)


def nameless(recording: Recording) -> list[Finding]:
    samples = prepare_samples(recording)
    drive = DriveSet.parse("viscous,coulomb")
    result = identify_samples(MODEL, samples, drive=drive, method="entropic")
    return list(report_nameless([validate_samples(result, samples)], [samples]))


def test_noise_does_not_return() -> None:
    assert nameless(log()) == []


@pytest.mark.parametrize("joint", [0, 3])
def test_friction_that_depends_on_position_has_no_name(joint: int) -> None:
    recording = log()
    tau = np.array(recording.tau)
    forward = np.sign(np.gradient(recording.q[:, joint], recording.t))
    tau[:, joint] += 1.5 * np.cos(3.0 * recording.q[:, joint]) * forward
    (finding,) = nameless(replace(recording, tau=tau))
    assert MODEL.joint_names[joint] in finding.message
    assert sum(name in finding.message for name in MODEL.joint_names) == 1
    assert "cannot name" in finding.message


def test_the_share_that_returns_is_that_of_the_curve() -> None:
    rng = np.random.default_rng(4)
    q = np.cumsum(rng.normal(size=20_000)) % 6.0
    forward = rng.random(q.size) < 0.5
    curve = np.where(forward, np.sin(2.0 * q), 0.3 * np.cos(5.0 * q))
    noise = rng.normal(size=q.size)
    share, error = returning_share(q, forward, curve + noise)
    true = float(np.var(curve) / np.mean((curve + noise) ** 2))
    assert share == pytest.approx(true, abs=0.05)
    assert error < 0.05
    share, error = returning_share(q, forward, noise)
    assert -0.05 < share < 0.0
