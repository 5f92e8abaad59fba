"""Dynamics of robots with joints that follow others, against MuJoCo's free tree."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from asbuilt.description import RobotModel
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.dynamics import (
    DriveSet,
    RegressorPlan,
    TorqueModel,
    coriolis_matrix,
    find_base_parameters,
    forward_dynamics,
    gravity_torque,
    inverse_dynamics,
    link_jacobians,
    link_poses,
    mass_matrix,
    observation_matrix,
    potential_energy,
)
from asbuilt.dynamics.kernels.regressor_adjoint import regressor_adjoint
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.momentum import Momentum
from coupled_robots import palletizer

NAMES = ("a1", "a2", "a3", "a6", "f1", "level", "f2", "f3")
E = np.array(
    [
        [1, 0, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, 1, 0, 0],
        [0, 0, 0, 1, 0],
        [0, 0, 0, 0, 1],
        [0, 0, -1, 0, 0],
        [0, 0, 0, 0, -1],
        [0, 0, 0, 0, -2],
    ],
    dtype=np.float64,
)
OFFSET = np.array([0, 0, 0, 0, 0, 0.1, 0.01, 0.04])
"""By hand: f3 = 2 f2 + 0.02 = 2 (0.01 - f1) + 0.02."""
STEP = 1e-6


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return palletizer()


@pytest.fixture(scope="module")
def states(robot: RobotModel) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(3, 8, robot.n_joints))


class FreeTree:
    """MuJoCo's tree with a drive at every joint; couplings are projected by hand."""

    def __init__(self, model: RobotModel) -> None:
        self.compiled = mujoco.MjModel.from_xml_string(format_mjcf(model, actuators=False))
        self.compiled.opt.disableflags |= int(
            mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
        )
        self.compiled.dof_armature[:] = self.compiled.dof_damping[:] = 0.0
        self.data: Any = mujoco.MjData(self.compiled)
        self.at = [self.compiled.joint(name).dofadr[0] for name in NAMES]

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        self.data.qpos[self.at], self.data.qvel[self.at] = E @ q + OFFSET, E @ qd
        self.data.qacc[self.at] = E @ qdd
        mujoco.mj_inverse(self.compiled, self.data)
        return E.T @ self.data.qfrc_inverse[self.at]

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        still = np.zeros(len(q))
        unit = [self.torque(q, still, each) for each in np.eye(len(q))]
        return np.array(unit).T - self.torque(q, still, still)[:, None]


def test_followers_are_set_apart(robot: RobotModel) -> None:
    assert robot.joint_names == NAMES[:5]
    assert tuple(joint.name for joint in robot.moving_joints) == NAMES
    assert robot.link_names == tuple(f"l_{name}" for name in NAMES)
    assert robot.link_joints == (0, 1, 2, 3, 4, 2, 4, 4)
    np.testing.assert_array_equal(robot.link_shares, E)
    assert (robot.n_joints, robot.n_links, robot.tool_link) == (5, 8, 3)


def test_torques_are_those_of_the_free_tree_projected(
    robot: RobotModel, states: np.ndarray
) -> None:
    tree = FreeTree(robot)
    q, qd, qdd = states
    tau = inverse_dynamics(robot, q, qd, qdd)
    np.testing.assert_allclose(
        tau, [tree.torque(*each) for each in zip(q, qd, qdd, strict=True)], atol=1e-11
    )
    M, C = mass_matrix(robot, q), coriolis_matrix(robot, q, qd)
    np.testing.assert_allclose(M, [tree.mass_matrix(each) for each in q], atol=1e-12)
    bias = np.einsum("sij,sj->si", C, qd) + gravity_torque(robot, q)
    np.testing.assert_allclose(np.einsum("sij,sj->si", M, qdd) + bias, tau, atol=1e-11)
    np.testing.assert_allclose(forward_dynamics(robot, q, qd, tau), qdd, atol=1e-9)
    np.testing.assert_allclose(TorqueModel(robot)(q[0], qd[0], qdd[0]), tau[0], atol=1e-12)


def test_regressor_gives_the_torques_and_any_of_its_columns(
    robot: RobotModel, states: np.ndarray
) -> None:
    tau = inverse_dynamics(robot, *states)
    Y = observation_matrix(robot, *states)
    np.testing.assert_allclose(Y @ robot.parameters, tau.ravel(), atol=1e-11)
    some = [71, 3, 55, 54, 20]
    np.testing.assert_array_equal(observation_matrix(robot, *states, columns=some), Y[:, some])


def test_momentum_poses_and_energy(robot: RobotModel, states: np.ndarray) -> None:
    q, qd, _ = states
    p, gradient = Momentum(robot, robot.parameters.reshape(-1, 10))(q, qd)
    np.testing.assert_allclose(p, np.einsum("sij,sj->si", mass_matrix(robot, q), qd), atol=1e-12)
    C = coriolis_matrix(robot, q, qd)
    np.testing.assert_allclose(gradient, np.einsum("sji,sj->si", C, qd), atol=1e-11)
    T, J = link_poses(robot, q), link_jacobians(robot, q)
    for j, step in enumerate(STEP * np.eye(robot.n_joints)):
        change = (link_poses(robot, q + step) - link_poses(robot, q - step)) / (2 * STEP)
        velocity = np.einsum("slba,slb->sla", T[..., :3, :3], change[..., :3, 3])
        np.testing.assert_allclose(velocity, J[..., 3:, j], atol=1e-8)
        slope = potential_energy(robot, q + step) - potential_energy(robot, q - step)
        np.testing.assert_allclose(slope / (2 * STEP), gravity_torque(robot, q)[:, j], atol=1e-7)


def test_derivatives_against_differences(robot: RobotModel, states: np.ndarray) -> None:
    slopes = torque_derivatives(robot, *states)[:, 0]
    plan = RegressorPlan.of(robot, columns=np.arange(5, 80), spare_rows=1)
    rng = np.random.default_rng(2)
    weights, loads = rng.normal(size=(plan.n_rows, 8)), rng.normal(size=states[0].shape)
    adjoint = regressor_adjoint(plan, *states, weights, loads, robot.parameters)

    def weighed(*state: np.ndarray) -> float:
        rows = zip(plan.bounds, plan.evaluate(*state), strict=True)
        total = sum(np.sum(weights[a:b] * found[: b - a]) for (a, b), found in rows)
        return float(total + np.sum(loads * inverse_dynamics(robot, *state)))

    for order in range(3):
        for j in range(robot.n_joints):
            sides = []
            for sign in (1.0, -1.0):
                moved = states.copy()
                moved[order, :, j] += sign * STEP
                sides.append((inverse_dynamics(robot, *moved), weighed(*moved)))
            change = (sides[0][0] - sides[1][0]) / (2 * STEP)
            np.testing.assert_allclose(slopes[:, :, j, order], change, atol=1e-6)
            whole = (sides[0][1] - sides[1][1]) / (2 * STEP)
            assert adjoint[order][:, j].sum() == pytest.approx(whole, rel=1e-6, abs=1e-4)


def test_base_parameters_have_the_rank_and_predict(robot: RobotModel) -> None:
    """By pivoted QR of other states, and as the first columns that are independent."""
    drive = DriveSet.parse("armature,viscous,coulomb,offset")
    base = find_base_parameters(robot, drive)
    states = np.random.default_rng(7).normal(size=(3, 200, robot.n_joints))
    Y = observation_matrix(robot, *states, drive=drive)
    np.testing.assert_allclose(Y[:, base.columns] @ base.regrouping, Y, atol=1e-9)
    sizes = np.linalg.norm(Y, axis=0)
    there = sizes > 1e-10 * sizes.max()
    scaled = Y[:, there] / sizes[there]
    s = np.linalg.svd(scaled, compute_uv=False)
    assert np.sum(s > 1e-10 * s[0]) == base.n_base
    assert s[base.n_base - 1] > 1e-6 * s[0]
    for j in (10, 40, 60, 72):
        kept = base.columns[base.columns <= j]
        own = np.linalg.svd(Y[:, kept] / sizes[kept], compute_uv=False)
        assert own[-1] > 1e-6 * own[0]
    assert {each.status for each in base.standard} == {"identifiable", "grouped", "unidentifiable"}


def test_fewer_parameters_are_identifiable_than_with_a_drive_at_every_joint(
    robot: RobotModel,
) -> None:
    assert find_base_parameters(robot).n_base < find_base_parameters(robot.tree).n_base
