"""Robots whose motors turn several joints, against Pinocchio and MuJoCo on the tree of bodies."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import PINOCCHIO_ORDER, pinocchio_model

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.dynamics import (
    find_base_parameters,
    gravity_torque,
    inverse_dynamics,
    mass_matrix,
    observation_matrix,
    regressor,
)
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.momentum import Momentum

ROBOTS = ("dvrk-psm", "dvrk-mtm")


def by_hand(name: str) -> tuple[tuple[str, ...], np.ndarray]:
    """The joints of the tree and how they stand, copied from the publication's equations."""
    if name == "dvrk-psm":
        rows = {
            "joint_1": [1, 0, 0, 0, 0, 0, 0],
            "joint_2": [0, 1, 0, 0, 0, 0, 0],
            "parallel_22": [0, -1, 0, 0, 0, 0, 0],
            "parallel_23": [0, -1, 0, 0, 0, 0, 0],
            "parallel_24": [0, 1, 0, 0, 0, 0, 0],
            "parallel_25": [0, 1, 0, 0, 0, 0, 0],
            "joint_3": [0, 0, 1, 0, 0, 0, 0],
            "counterweight_slide": [0, 0, 1, 0, 0, 0, 0],
            "joint_4": [0, 0, 0, 1, 0, 0, 0],
            "wrist_pitch": [0, 0, 0, 0, 1.0186, 0, 0],
            "jaw_1": [0, 0, 0, 0, -0.8306, 1.2178, 0],
            "jaw_2": [0, 0, 0, 0, -0.8306, 0, 1.2178],
        }
    else:
        rows = {
            "joint_1": [1, 0, 0, 0, 0, 0, 0],
            "joint_2": [0, 1, 0, 0, 0, 0, 0],
            "forearm_30": [0, -1, 1, 0, 0, 0, 0],
            "joint_3": [0, 0, 1, 0, 0, 0, 0],
            "parallel_32": [0, 1, -1, 0, 0, 0, 0],
            "platform": [0, 0.6697, -0.6697, 1, 0, 0, 0],
            "joint_5": [0, 0, 0, 0, 1, 0, 0],
            "joint_6": [0, 0, 0, 0, 0, 1, 0],
            "joint_7": [0, 0, 0, 0, 0, 0, 1],
        }
    return tuple(rows), np.array(list(rows.values()), dtype=np.float64)


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> RobotModel:
    return bundled_robot(request.param)


@pytest.fixture(scope="module")
def states(robot: RobotModel) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(3, 6, robot.n_joints))


def test_the_regressor_is_that_of_pinocchio_on_the_tree(
    robot: RobotModel, states: np.ndarray
) -> None:
    """`Y = A^T Y_tree(A q, A qd, A qdd)`, with parameters of each link about its joint frame."""
    tree = robot.tree
    names, A = by_hand(robot.name)
    A = A[[names.index(name) for name in tree.joint_names]]
    built = pinocchio_model(tree)
    data = built.createData()
    chi = np.concatenate([built.inertias[k + 1].toDynamicParameters() for k in range(tree.n_links)])
    for q, qd, qdd in zip(*states, strict=True):
        Y = A.T @ pin.computeJointTorqueRegressor(built, data, A @ q, A @ qd, A @ qdd)
        np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd), Y @ chi, atol=1e-10)
        ours = regressor(robot, q, qd, qdd).reshape(robot.n_joints, robot.n_links, 10)
        for k, link in enumerate(tree.link_names):
            if np.array_equal(tree.joints[k].after, np.eye(4)):
                theirs = np.empty((robot.n_joints, 10))
                theirs[:, PINOCCHIO_ORDER] = Y[:, 10 * k : 10 * k + 10]
                own = ours[:, robot.link_names.index(link)]
                np.testing.assert_allclose(own, theirs, atol=1e-10)
        still = np.zeros(tree.n_joints)
        unit = [pin.rnea(built, data, A @ q, still, A[:, k]).copy() for k in range(len(q))]
        M = A.T @ (np.array(unit) - pin.rnea(built, data, A @ q, still, still)).T
        np.testing.assert_allclose(mass_matrix(robot, q), M, atol=1e-10)


def test_mujoco_projects_the_tree_to_the_same_torque(robot: RobotModel, states: np.ndarray) -> None:
    compiled = mujoco.MjModel.from_xml_string(format_mjcf(robot, actuators=False))
    compiled.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    compiled.dof_armature[:] = compiled.dof_damping[:] = 0.0
    data = mujoco.MjData(compiled)
    names, A = by_hand(robot.name)
    at = [compiled.joint(name).dofadr[0] for name in names]
    for q, qd, qdd in zip(*states, strict=True):
        data.qpos[:] = data.qvel[:] = data.qacc[:] = 0.0
        data.qpos[at], data.qvel[at], data.qacc[at] = A @ q, A @ qd, A @ qdd
        mujoco.mj_inverse(compiled, data)
        expected = A.T @ data.qfrc_inverse[at]
        np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd), expected, atol=1e-9)


def test_mujocos_equalities_hold_where_the_couplings_say(robot: RobotModel) -> None:
    """Joints and tendons of the written file have no violation at coupled positions, else some."""
    compiled = mujoco.MjModel.from_xml_string(format_mjcf(robot))
    data = mujoco.MjData(compiled)
    whole = robot.with_rotors
    q = np.random.default_rng(5).normal(size=robot.n_joints)
    at = [compiled.joint(joint.name).qposadr[0] for joint in whole.moving_joints]
    data.qpos[at] = whole.link_positions(q)
    mujoco.mj_forward(compiled, data)
    assert compiled.neq == len(whole.followers)
    equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    np.testing.assert_allclose(data.efc_pos[equal], 0.0, atol=1e-12)
    data.qpos[at[-1]] += 0.1
    mujoco.mj_forward(compiled, data)
    equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    assert np.abs(data.efc_pos[equal]).max() > 0.09


def test_mjcf_is_read_back_to_the_same_torques(robot: RobotModel, states: np.ndarray) -> None:
    read = read_mjcf(format_mjcf(robot))
    order = [read.joint_names.index(name) for name in robot.joint_names]
    there = np.empty_like(states)
    there[:, :, order] = states
    torque = inverse_dynamics(read, *there)[:, order]
    np.testing.assert_allclose(torque, inverse_dynamics(robot, *states), atol=1e-9)


@pytest.mark.parametrize(("name", "count"), [("dvrk-psm", 49), ("dvrk-mtm", 76)])
def test_base_parameters_by_two_roads(name: str, count: int) -> None:
    """49 for the patient-side arm: Wang et al., RA-L 4, 2019, table II; 76 by SVD of this test."""
    robot = bundled_robot(name)
    drive = choose_usual_drive(robot, "motor")
    base = find_base_parameters(robot, drive)
    states = np.random.default_rng(8).normal(size=(3, 150, robot.n_joints))
    Y = observation_matrix(robot, *states, drive=drive)
    too_light = [k for k, link in enumerate(robot.links) if link.negligible]
    Y[:, [10 * k + j for k in too_light for j in range(10)]] = 0.0
    sizes = np.linalg.norm(Y, axis=0)
    there = sizes > 1e-12 * sizes.max()
    s = np.linalg.svd(Y[:, there] / sizes[there], compute_uv=False)
    assert base.n_base == count == np.sum(s > 1e-10 * s[0])
    np.testing.assert_allclose(Y[:, base.columns] @ base.regrouping, Y, atol=1e-8)


def test_derivatives_momentum_and_gravity(robot: RobotModel, states: np.ndarray) -> None:
    slopes = torque_derivatives(robot, *states)[:, 0]
    q, qd, _ = states
    p, _ = Momentum(robot, robot.parameters.reshape(-1, 10))(q, qd)
    np.testing.assert_allclose(p, np.einsum("sij,sj->si", mass_matrix(robot, q), qd), atol=1e-12)
    rest = np.zeros_like(q)
    np.testing.assert_allclose(
        gravity_torque(robot, q), inverse_dynamics(robot, q, rest, rest), atol=1e-12
    )
    step = 1e-6
    for j in range(robot.n_joints):
        moved = [states.copy(), states.copy()]
        moved[0][0, :, j] += step
        moved[1][0, :, j] -= step
        change = np.subtract(*(inverse_dynamics(robot, *each) for each in moved)) / (2 * step)
        np.testing.assert_allclose(slopes[:, :, j, 0], change, atol=1e-6)
