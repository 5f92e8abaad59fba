"""Sensor and motor torque together: a simulated gear with a sensor behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet, drive_torque, find_base_parameters, inverse_dynamics
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification import identify_samples, identify_two_channels
from asbuilt.identification.calibration.two_channels import LINK_SIDE, MOTOR_SIDE

ROBOT = bundled_robot("kuka-iiwa7-r800")


@pytest.fixture(scope="module")
def channels():
    rng = np.random.default_rng(2)
    trajectory = random_fourier(ROBOT, 4, duration=30.0).sample(100.0)
    state = (trajectory.q, trajectory.qd, trajectory.qdd)
    links = rng.uniform(0.05, 0.2, (7, 3)).ravel()
    motor = rng.uniform(0.3, 1.2, (7, 4)).ravel()
    behind = inverse_dynamics(ROBOT, *state) + drive_torque(LINK_SIDE, links, *state)
    ahead = behind + drive_torque(MOTOR_SIDE, motor, *state)
    shape = behind.shape

    def samples(tau, noise, source):
        return Samples(
            trajectory.t,
            *state,
            tau + noise * rng.normal(size=shape),
            rate=100.0,
            joint_names=ROBOT.joint_names,
            torque_source=source,
        )

    return samples(behind, 0.05, "sensor"), samples(ahead, 0.5, "motor"), links, motor


def test_both_sides_come_back(channels):
    sensor, motor, links, truth = channels
    found = identify_two_channels(ROBOT, sensor, motor)
    assert len(found.names) == find_base_parameters(ROBOT, LINK_SIDE).n_base + 28
    named = [f"{symbol}{k + 1}" for k in range(7) for symbol in ("Iam", "Fvm", "Fcm", "Fom")]
    values = dict(zip(found.names, found.values.tolist(), strict=True))
    errors = np.array([values[name] for name in named]) - truth
    sigmas = np.array([found.std_errors[found.names.index(name)] for name in named])
    assert np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.6
    np.testing.assert_allclose(
        [values[f"Fv{k + 1}"] for k in range(7)], links.reshape(7, 3)[:, 0], atol=0.03
    )
    np.testing.assert_allclose(found.rms_sensor, 0.05, rtol=0.15)
    np.testing.assert_allclose(found.rms_motor, 0.5, rtol=0.15)


def test_the_sensor_decides_what_both_see_where_it_is_the_better(channels):
    sensor, motor, *_ = channels
    together = identify_two_channels(ROBOT, sensor, motor)
    alone = identify_samples(ROBOT, sensor, drive=LINK_SIDE)
    p = len(alone.parameters)
    assert together.names[:p] == tuple(parameter.name for parameter in alone.parameters)
    np.testing.assert_allclose(
        together.values[:p], alone.estimates, atol=1.0 * np.abs(alone.std_errors).max()
    )
    textbook = np.sqrt(np.diag(together.estimate.covariance))[:p]
    assert np.all(
        textbook
        <= 1.05 * np.array([parameter.textbook_std_error for parameter in alone.parameters])
    )


def test_a_coupled_wrist_is_seen_from_the_motors():
    coupling = np.eye(7)
    coupling[6, 5] = 1.0
    robot = replace(ROBOT, motor_coupling=coupling)
    ahead = DriveSet.parse(
        "armature,motor_armature:joints=7,viscous,motor_viscous:joints=7,coulomb,motor_coulomb:joints=7,offset"
    )
    rng = np.random.default_rng(6)
    trajectory = random_fourier(ROBOT, 4, duration=30.0).sample(100.0)
    state = (trajectory.q, trajectory.qd, trajectory.qdd)
    truth = rng.uniform(0.3, 1.2, (7, ahead.columns_per_joint))
    behind = inverse_dynamics(ROBOT, *state) + drive_torque(
        LINK_SIDE, np.tile([0.1, 0.2, 0.1], 7), *state
    )
    felt = behind + drive_torque(ahead, truth.ravel(), *state, shares=robot.motor_shares)
    sensor, motor = (
        Samples(
            trajectory.t,
            *state,
            tau + noise * rng.normal(size=tau.shape),
            rate=100.0,
            joint_names=ROBOT.joint_names,
            torque_source=source,
        )
        for tau, noise, source in ((behind, 0.05, "sensor"), (felt, 0.5, "motor"))
    )
    found = identify_two_channels(robot, sensor, motor)
    assert found.names[-7:] == ("Iam7", "Iamm7", "Fvm7", "Fvmm7", "Fcm7", "Fcmm7", "Fom7")
    assert (
        len(found.names)
        == len(set(found.names))
        == find_base_parameters(robot, LINK_SIDE).n_base + 28 + 3
    )
    assert found.of_motor_side.sum() == 31
    errors = (found.values[-7:] - truth[6]) / found.std_errors[-7:]
    assert np.sqrt(np.mean(errors**2)) < 2.0
    np.testing.assert_allclose(found.rms_motor, 0.5, rtol=0.15)
    uncoupled = identify_two_channels(ROBOT, sensor, motor)
    assert np.all(uncoupled.rms_motor[5:] > 0.6)


def test_channels_of_different_instants_are_refused(channels):
    sensor, motor, *_ = channels
    with pytest.raises(UsageError, match="same instants"):
        identify_two_channels(ROBOT, sensor, replace(motor, t=motor.t + 0.5))
    with pytest.raises(UsageError, match="both channels"):
        identify_two_channels(ROBOT, [sensor, sensor], motor)
    with pytest.raises(UsageError, match="nonlinear parameters that are stated"):
        identify_two_channels(ROBOT, sensor, motor, link_side=DriveSet.parse("stribeck"))
    with pytest.raises(UsageError, match="load"):
        identify_two_channels(ROBOT, sensor, motor, motor_side=DriveSet.parse("load_friction"))


def test_wrong_motor_gain_is_found_and_does_not_bend_the_motor_side(channels):
    sensor, motor, _, truth = channels
    wrong = np.ones(7)
    wrong[[1, 3]] = 0.87, 1.1
    found = identify_two_channels(ROBOT, sensor, replace(motor, tau=motor.tau * wrong))
    (finding,) = found.findings
    assert [name in finding.message for name in ROBOT.joint_names] == list(wrong != 1.0)
    errors = (found.scales - wrong) / found.scale_errors
    assert np.all(np.abs(errors) < 4.0)
    for k in (1, 3):
        armature = found.names.index(f"Iam{k + 1}")
        assert abs(found.values[armature] - truth[4 * k]) < 4.0 * found.std_errors[armature]


def test_right_motor_gains_are_left_alone(channels):
    sensor, motor, *_ = channels
    assert identify_two_channels(ROBOT, sensor, motor).findings == ()
