"""Robots with loops against MuJoCo's equality constraints and against differences."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import RobotModel
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.dynamics import (
    RegressorPlan,
    coriolis_matrix,
    coriolis_torque,
    find_base_parameters,
    forward_dynamics,
    inverse_dynamics,
    kinetic_energy,
    link_jacobians,
    link_poses,
    mass_matrix,
    observation_matrix,
    potential_energy,
    regressor,
)
from asbuilt.dynamics.base.observation_rank import find_negligible_columns
from asbuilt.dynamics.kernels.regressor_adjoint import regressor_adjoint
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.kinematics import draw_postures
from asbuilt.dynamics.momentum import Momentum
from closed_chains import NAMES, robot_with_loops

mujoco = pytest.importorskip("mujoco")
SAMPLES = 20


def states(model: RobotModel, count: int = SAMPLES, seed: int = 0):
    rng = np.random.default_rng(seed)
    q = draw_postures(model, rng, count)
    return q, rng.normal(size=q.shape) * 2.0, rng.normal(size=q.shape) * 5.0


class Constrained:
    """MuJoCo's tree with its own constraint Jacobian, projected on the motors."""

    def __init__(self, model: RobotModel) -> None:
        self.compiled = mujoco.MjModel.from_xml_string(format_mjcf(model, shapes=False))
        off = mujoco.mjtDisableBit
        self.compiled.opt.disableflags |= int(off.mjDSBL_LIMIT)
        self.compiled.dof_frictionloss[:] = 0.0
        self.compiled.dof_damping[:] = 0.0
        self.compiled.dof_armature[:] = 0.0
        self.data = mujoco.MjData(self.compiled)
        at = [
            mujoco.mj_name2id(self.compiled, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
            for joint in model.moving_joints
        ]
        self.every, self.n = np.array(at), model.n_joints

    def jacobian(self, positions):
        self.data.qpos[self.every] = positions
        mujoco.mj_forward(self.compiled, self.data)
        return self.data.efc_J.reshape(-1, self.compiled.nv)[: self.data.ne, self.every].copy()

    def torque(self, positions, qd, qdd):
        J, n, h = self.jacobian(positions), self.n, 1e-6
        G = np.vstack([np.eye(n), -np.linalg.lstsq(J[:, n:], J[:, :n], rcond=1e-9)[0]])
        rate = G @ qd
        turning = (self.jacobian(positions + h * rate) - self.jacobian(positions - h * rate)) / (
            2 * h
        )
        away = -turning @ rate - J[:, :n] @ qdd
        acceleration = np.r_[qdd, np.linalg.lstsq(J[:, n:], away, rcond=1e-9)[0]]
        data, flag = self.data, int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        data.qpos[self.every], data.qvel[self.every] = positions, rate
        data.qacc[self.every] = acceleration
        self.compiled.opt.disableflags |= flag
        mujoco.mj_inverse(self.compiled, data)
        self.compiled.opt.disableflags &= ~flag
        return G.T @ data.qfrc_inverse[self.every], G


@pytest.mark.parametrize("name", NAMES)
def test_torques_are_those_of_mujoco_with_equality_constraints(name: str) -> None:
    model = robot_with_loops(name)
    q, qd, qdd = states(model)
    engine, moved = Constrained(model), model.link_motion(q, qd, qdd)
    found = [engine.torque(moved.q[k], qd[k], qdd[k]) for k in range(len(q))]
    tau = inverse_dynamics(model, q, qd, qdd)
    size = np.abs(tau).max()
    np.testing.assert_allclose(tau, [torque for torque, _ in found], atol=1e-6 * size, rtol=0)
    np.testing.assert_allclose(moved.shares, [G for _, G in found], atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_points_of_loops_coincide_and_their_rates_too(name: str) -> None:
    model = robot_with_loops(name)
    q, qd, _ = states(model)
    poses, jacobians = link_poses(model, q), link_jacobians(model, q)
    for loop in model.loops:
        at, rates = [], []
        for link, point in (model.place_of(*end) for end in loop.ends):
            if link < 0:
                at.append(np.broadcast_to(point, (len(q), 3)))
                rates.append(np.zeros((len(q), 3)))
                continue
            R = poses[:, link, :3, :3]
            at.append(R @ point + poses[:, link, :3, 3])
            twist = np.einsum("sij,sj->si", jacobians[:, link], qd)
            inside = twist[:, 3:] + np.cross(twist[:, :3], point)
            rates.append(np.einsum("sij,sj->si", R, inside))
        np.testing.assert_allclose(at[0], at[1], atol=1e-12)
        np.testing.assert_allclose(rates[0], rates[1], atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_motion_of_passive_joints_is_the_derivative_of_their_positions(name: str) -> None:
    model = robot_with_loops(name)
    q, qd, qdd = states(model)
    moved, h = model.link_motion(q, qd, qdd), 1e-4
    path = [model.link_positions(q + s * qd * h + 0.5 * qdd * (s * h) ** 2) for s in (-1, 0, 1)]
    np.testing.assert_allclose((path[2] - path[0]) / (2 * h), moved.qd, atol=1e-4)
    second = (path[2] - 2 * path[1] + path[0]) / h**2
    np.testing.assert_allclose(second, moved.qdd, atol=1e-2, rtol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_every_form_of_the_equations_of_motion_agrees(name: str) -> None:
    model = robot_with_loops(name)
    q, qd, qdd = states(model)
    tau = inverse_dynamics(model, q, qd, qdd)
    size = np.abs(tau).max()
    Y = observation_matrix(model, q, qd, qdd)
    np.testing.assert_allclose(Y @ model.parameters, tau.ravel(), atol=1e-12 * size)
    # A posture has the rounding of the way to it, which one sample goes alone.
    one = regressor(model, q[0], qd[0], qdd[0])
    np.testing.assert_allclose(one, Y[: model.n_joints], atol=1e-12 * np.abs(Y).max())
    rows = RegressorPlan.of(model).evaluate(q, qd, qdd)
    support = RegressorPlan.of(model).support
    sums = [r.T @ model.parameters[at] for r, at in zip(rows, support, strict=True)]
    np.testing.assert_allclose(np.column_stack(sums), tau, atol=1e-12 * size)
    M = mass_matrix(model, q)
    there = forward_dynamics(model, q, qd, tau)
    worst = np.abs(qdd).max() * np.linalg.cond(M).max()
    np.testing.assert_allclose(there, qdd, atol=1e-9 * worst)
    C = coriolis_matrix(model, q, qd)
    np.testing.assert_allclose(
        np.einsum("sij,sj->si", C, qd), coriolis_torque(model, q, qd), atol=1e-10 * size
    )
    h = 1e-6
    turning = (mass_matrix(model, q + h * qd) - mass_matrix(model, q - h * qd)) / (2 * h)
    np.testing.assert_allclose(turning, C + np.swapaxes(C, 1, 2), atol=1e-6 * np.abs(C).max())
    p, gradient = Momentum(model, model.parameters.reshape(-1, 10))(q, qd)
    np.testing.assert_allclose(p, np.einsum("sij,sj->si", M, qd), atol=1e-12 * size)
    np.testing.assert_allclose(gradient, np.einsum("sji,sj->si", C, qd), atol=1e-9 * size)


@pytest.mark.parametrize("name", NAMES)
def test_power_of_the_motors_is_the_change_of_energy(name: str) -> None:
    model = robot_with_loops(name)
    q, qd, qdd = states(model)
    h = 1e-5

    def energy(s):
        at, rate = q + s * qd + 0.5 * s**2 * qdd, qd + s * qdd
        return kinetic_energy(model, at, rate) + potential_energy(model, at)

    power = np.einsum("si,si->s", inverse_dynamics(model, q, qd, qdd), qd)
    np.testing.assert_allclose((energy(h) - energy(-h)) / (2 * h), power, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_differences(name: str) -> None:
    model = robot_with_loops(name)
    state, h = states(model, 6), 1e-6
    rng = np.random.default_rng(3)
    exact = torque_derivatives(model, *state)[:, 0]
    plan = RegressorPlan.of(model)
    weights = rng.normal(size=(plan.n_rows, 6))
    loads = rng.normal(size=state[0].shape)
    gradient = regressor_adjoint(plan, *state, weights, loads=loads, parameters=model.parameters)

    def value(at):
        out = plan.buffer(6)
        plan.evaluate(*at, out)
        tau = inverse_dynamics(model, *at)
        return tau, (weights * out[:, :6]).sum(axis=0) + (loads * tau).sum(axis=1)

    for order in range(3):
        for j in range(model.n_joints):
            sides = []
            for sign in (1.0, -1.0):
                at = [part.copy() for part in state]
                at[order][:, j] += sign * h
                sides.append(value(at))
            tau = (sides[0][0] - sides[1][0]) / (2 * h)
            size = max(np.abs(exact[..., order]).max(), 1.0)
            np.testing.assert_allclose(exact[:, :, j, order], tau, atol=2e-6 * size)
            total = (sides[0][1] - sides[1][1]) / (2 * h)
            size = max(np.abs(total).max(), 1.0)
            np.testing.assert_allclose(gradient[order][:, j], total, atol=5e-6 * size)


@pytest.mark.parametrize(
    ("name", "count"),
    [("four-bar", 8), ("palletizer", 22), ("delta", 34), ("piston", 8), ("ankle", 31)],
)
def test_base_parameters_reproduce_torques_and_keep_their_names(name: str, count: int) -> None:
    model = robot_with_loops(name)
    base = find_base_parameters(model)
    assert base.n_base == count
    state = states(model, 60, seed=7)
    Y = observation_matrix(model, *state)
    Y[:, find_negligible_columns(model)] = 0.0
    np.testing.assert_allclose(Y[:, base.columns] @ base.regrouping, Y, atol=1e-7 * np.abs(Y).max())
    again = find_base_parameters(robot_with_loops(name).with_gravity(model.gravity))
    assert again.names == base.names
