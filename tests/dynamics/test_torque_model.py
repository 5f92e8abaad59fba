"""Torque of one sample: against Pinocchio, against many samples, and with any drive terms."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_robot

from asbuilt.dynamics import (
    DriveSet,
    TorqueModel,
    available_terms,
    gravity_torque,
    inverse_dynamics,
    mass_matrix,
)
from asbuilt.dynamics.drives.drive_set import NO_DRIVE
from asbuilt.errors import UsageError

CASES = [(style, n) for style in ("general", "distal", "proximal") for n in (1, 2, 7, 12)]
RICH = (
    "armature,viscous,coulomb:joints=2/3,stribeck:velocity=0.2:power=1.5,load_friction,balancer,"
    "power:exponent=0.4/0.5/0.6,motor_armature,motor_viscous,motor_coulomb,asymmetric_coulomb,"
    "asymmetric_viscous,smooth_coulomb,quadratic,cubic,spring,offset,"
    "load_stribeck,quadratic_load_stribeck,directional_load_stribeck,directional_load_friction,"
    "extension_spring:inner=0.03:outer=0.2:angle=0.4:length=0.1,cable:order=5/2/7,motor_cable:order=4"
    ",cylinder:inner=0.1:outer=0.3:angle=-0.4:length=0.2:axial=0.05/0.1/0.2:rate=2"
)


def close(found, expected):
    assert np.shape(found) == np.shape(expected)
    np.testing.assert_allclose(found, expected, atol=1e-12 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize(("style", "n"), CASES)
def test_one_sample_is_that_of_pinocchio(style, n):
    rng = np.random.default_rng(n)
    model = random_robot(rng, n, style=style)
    peer = pinocchio_model(model)
    data = peer.createData()
    for _ in range(3):
        q, qd, qdd = rng.normal(scale=3.0, size=(3, n))
        close(inverse_dynamics(model, q, qd, qdd), pin.rnea(peer, data, q, qd, qdd))
        close(gravity_torque(model, q), pin.computeGeneralizedGravity(peer, data, q))
        rest = np.zeros(n)
        columns = [pin.rnea(peer, data, q, rest, unit) for unit in np.eye(n)]
        close(mass_matrix(model, q), np.array(columns) - pin.rnea(peer, data, q, rest, rest))


def coupled_arm(rng):
    model = random_robot(rng, 3)
    coupling = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.4], [0.0, -0.3, 1.0]])
    return replace(model, motor_coupling=coupling)


def test_every_drive_term_acts_on_one_sample_as_on_many():
    assert set(DriveSet.parse(RICH).keys) == set(available_terms())
    rng = np.random.default_rng(3)
    model, drive = coupled_arm(rng), DriveSet.parse(RICH)
    torque = TorqueModel(model, drive, rng.normal(size=3 * drive.columns_per_joint))
    motion = rng.normal(size=(3, 20, 3))
    motion[1, :3, 1] = 0.0
    many = torque(*motion)
    close(many - inverse_dynamics(model, *motion), torque.friction(*motion))
    for sample, expected in zip(motion.transpose(1, 0, 2), many, strict=True):
        close(torque(*sample), expected)
        close(torque.friction(*sample), expected - inverse_dynamics(model, *sample))
        close(torque.gravity(sample[0]), gravity_torque(model, sample[0]))
        close(torque.mass_matrix(sample[0]), mass_matrix(model, sample[0]))


def test_other_inertial_parameters_take_the_place_of_the_models():
    rng = np.random.default_rng(5)
    model, other = coupled_arm(rng), random_robot(rng, 3)
    torque = TorqueModel(model, parameters=other.parameters)
    q, qd, qdd = rng.normal(size=(3, 3))
    close(torque(q, qd, qdd), inverse_dynamics(model, q, qd, qdd, parameters=other.parameters))
    close(torque.gravity(q), gravity_torque(model, q, parameters=other.parameters))
    close(torque.mass_matrix(q), mass_matrix(model, q, parameters=other.parameters))


@pytest.mark.parametrize(
    "like",
    [
        lambda x: x.tolist(),
        lambda x: x.astype(np.float32),
        lambda x: np.stack([x, x], axis=1)[:, 0],
        lambda x: np.broadcast_to(x, x.shape),
        lambda x: x[None],
    ],
    ids=["list", "float32", "strided", "read-only", "one row"],
)
def test_any_array_of_one_sample_is_taken(like):
    rng = np.random.default_rng(7)
    model, drive = coupled_arm(rng), DriveSet.parse("viscous,coulomb")
    torque = TorqueModel(model, drive, rng.normal(size=6))
    q, qd, qdd = rng.normal(size=(3, 3)).astype(np.float32).astype(float)
    expected = torque(q, qd, qdd)
    for state in ((like(q), qd, qdd), (like(q), like(qd), like(qdd))):
        if np.ndim(state[0]) == np.ndim(state[1]):
            close(np.reshape(torque(*state), 3), expected)
    close(np.reshape(torque.gravity(like(q)), 3), torque.gravity(q))
    close(np.reshape(torque.mass_matrix(like(q)), (3, 3)), torque.mass_matrix(q))
    close(
        np.reshape(inverse_dynamics(model, like(q), like(qd), like(qdd)), 3),
        TorqueModel(model)(q, qd, qdd),
    )


def test_threads_share_a_model():
    rng = np.random.default_rng(9)
    torque = TorqueModel(coupled_arm(rng))
    motion = rng.normal(size=(400, 3, 3))
    expected = [torque(*state) for state in motion]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda state: torque(*state), motion))
    np.testing.assert_array_equal(found, expected)


def test_what_does_not_fit_is_refused_for_one_sample_too():
    model = coupled_arm(np.random.default_rng(1))
    torque = TorqueModel(model)
    zero, bad = np.zeros(3), np.array([0.0, np.nan, 0.0])
    for call in (
        lambda: torque(zero, bad, zero),
        lambda: inverse_dynamics(model, zero, zero, bad),
        lambda: gravity_torque(model, bad),
        lambda: torque.mass_matrix(bad),
    ):
        with pytest.raises(UsageError, match="is nan at sample 0"):
            call()
    with pytest.raises(UsageError, match=r"qd must have shape \(3,\)"):
        torque(zero, np.zeros(4), zero)
    with pytest.raises(UsageError, match="6 drive parameters, got shape"):
        TorqueModel(model, DriveSet.parse("viscous,offset"), [0.0] * 5)
    with pytest.raises(UsageError, match="30 inertial parameters"):
        TorqueModel(model, NO_DRIVE, parameters=[0.0] * 29)


def test_results_of_two_calls_are_two_arrays():
    model = coupled_arm(np.random.default_rng(2))
    torque = TorqueModel(model)
    one = torque(*np.ones((3, 3)))
    kept = one.copy()
    torque(*np.zeros((3, 3)))
    np.testing.assert_array_equal(one, kept)
