"""Equations of motion `M(q) qdd + C(q, qd) qd + g(q) = tau` of bodies, for many samples or one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.batches import (
    flatten_array,
    inertial_parameters,
    run_over_samples,
    shape_joint_samples,
)
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.dynamics.drives.term import STATE, Formula
from asbuilt.dynamics.kernels import rigid_body, single_sample
from asbuilt.dynamics.kernels.joint_space import joint_space_matrices
from asbuilt.dynamics.kernels.operations import ACT, ADD, MULTIPLY, NUMBER, OPERATIONS, SPEND
from asbuilt.dynamics.kernels.recursion import build_layout
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import InertiaError


def _evaluate_torques(
    model: RobotModel,
    q: Array,
    qd: Array,
    qdd: Array,
    chi: Array,
    gravity: Array,
    threads: int | None,
) -> Array:
    moved = model.joint_map.motion(q, qd, qdd)
    bodies = model.joint_map.parameters(chi)
    layout = build_layout(model.tree)
    torques = np.empty(moved.q.shape)
    inputs = flatten_array(moved.q), flatten_array(moved.qd), flatten_array(moved.qdd)
    given = np.array(gravity, dtype=np.float64)
    out = torques.reshape(-1)
    run_over_samples(
        lambda start, stop: rigid_body.newton_euler(
            layout.codes, layout.placements, given, bodies, *inputs, start, stop, out
        ),
        q.shape[0],
        threads,
    )
    return moved.torques(torques)


def _evaluate_joint_space(
    model: RobotModel, q: Array, qd: Array, chi: Array, *, coriolis: bool
) -> Array:
    moved = model.joint_map.motion(q, qd)
    state = moved.q, moved.qd, model.joint_map.parameters(chi)
    found = moved.matrices(_evaluate_tree_matrices(model.tree, *state, coriolis=coriolis))
    change = model.joint_map.derivatives(q, qd, np.zeros_like(q)) if coriolis else None
    if change is None:
        return found
    masses = _evaluate_tree_matrices(model.tree, *state, coriolis=False)
    return found + np.swapaxes(moved.shares, 1, 2) @ masses @ change.turning


def _evaluate_tree_matrices(
    model: RobotModel, q: Array, qd: Array, chi: Array, *, coriolis: bool
) -> Array:
    layout = build_layout(model)
    samples, n = q.shape
    matrices = np.empty((samples, n, n))
    angles = flatten_array(q)
    rates = flatten_array(qd)
    out = matrices.reshape(-1)

    def work(start: int, stop: int) -> None:
        joint_space_matrices(
            layout.codes,
            layout.chain,
            layout.placements,
            layout.n_slots,
            chi,
            angles,
            rates,
            coriolis,
            start,
            stop,
            out,
        )

    run_over_samples(work, samples, None)
    return matrices


def inverse_dynamics(
    model: RobotModel,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    *,
    parameters: ArrayLike | None = None,
    threads: int | None = None,
) -> Array:
    """Return the joint torques `tau = M(q) qdd + C(q, qd) qd + g(q)` of the rigid bodies [N m.

    N for prismatic joints].

    `q, qd, qdd` have shape (n_joints,) or (n_samples, n_joints), and so has the result.
    `parameters` (10 n_links,) replace the model's own. `threads` None uses all cores for long
    inputs; the result does not depend on it. Raises UsageError for shapes that do not fit and for
    values that are not finite. Source: Luh, Walker and Paul (1980).
    """
    if parameters is None and type(q) is np.ndarray and q.ndim == 1:
        one = compile_rigid_bodies(model).torque(q, qd, qdd)
        if one is not None:
            return one
    qs, qds, qdds = shape_joint_samples(model, q=q, qd=qd, qdd=qdd)
    return _evaluate_torques(
        model, qs, qds, qdds, inertial_parameters(model, parameters), model.gravity, threads
    ).reshape(np.shape(q))


def gravity_torque(
    model: RobotModel, q: ArrayLike, *, parameters: ArrayLike | None = None
) -> Array:
    """Return `g(q)`, the torque that holds the robot at rest, shape of `q`."""
    if parameters is None and type(q) is np.ndarray and q.ndim == 1:
        one = compile_rigid_bodies(model).gravity(q)
        if one is not None:
            return one
    (qs,) = shape_joint_samples(model, q=q)
    rest = np.zeros_like(qs)
    return _evaluate_torques(
        model, qs, rest, rest, inertial_parameters(model, parameters), model.gravity, None
    ).reshape(np.shape(q))


def coriolis_torque(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, *, parameters: ArrayLike | None = None
) -> Array:
    """Return `C(q, qd) qd`, the torque of centrifugal and Coriolis forces, shape of `q`."""
    qs, qds = shape_joint_samples(model, q=q, qd=qd)
    return _evaluate_torques(
        model, qs, qds, np.zeros_like(qs), inertial_parameters(model, parameters), np.zeros(3), None
    ).reshape(np.shape(q))


def mass_matrix(model: RobotModel, q: ArrayLike, *, parameters: ArrayLike | None = None) -> Array:
    """Return the mass matrix `M(q) = sum_i J_i^T I_i J_i`, symmetric.

    Shape (n_joints, n_joints), or (n_samples, n_joints, n_joints) for many samples.
    """
    if parameters is None and type(q) is np.ndarray and q.ndim == 1:
        one = compile_rigid_bodies(model).mass_matrix(q)
        if one is not None:
            return one
    (qs,) = shape_joint_samples(model, q=q)
    return _evaluate_joint_space(
        model, qs, qs, inertial_parameters(model, parameters), coriolis=False
    ).reshape(*np.shape(q), model.n_joints)


def coriolis_matrix(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, *, parameters: ArrayLike | None = None
) -> Array:
    """Return the factor `C(q, qd)` of the Coriolis torque, shape as `mass_matrix`.

    `C qd` is the Coriolis torque and `dM/dt - 2 C` is skew-symmetric.

    `C = sum_i J_i^T (I_i dJ_i/dt + B_i J_i)` with the skew-symmetric `B = -[[hat(L), hat(p)],
    [hat(p), 0]]`, where p and L are the momentum of link i and its moment about the link origin, so
    that `B v` is the gyroscopic wrench. Source: the factorisations of Niemeyer and Slotine (1991),
    written for link frames. It is not the Christoffel factor, which agrees with it only in these
    two properties.
    """
    qs, qds = shape_joint_samples(model, q=q, qd=qd)
    return _evaluate_joint_space(
        model, qs, qds, inertial_parameters(model, parameters), coriolis=True
    ).reshape(*np.shape(q), model.n_joints)


def forward_dynamics(
    model: RobotModel,
    q: ArrayLike,
    qd: ArrayLike,
    tau: ArrayLike,
    *,
    parameters: ArrayLike | None = None,
) -> Array:
    """Return the joint accelerations `qdd = M(q)^-1 (tau - C(q, qd) qd - g(q))`, shape of `q`.

    Raises InertiaError where the mass matrix is not positive definite.
    """
    qs, qds, taus = shape_joint_samples(model, q=q, qd=qd, tau=tau)
    chi = inertial_parameters(model, parameters)
    bias = _evaluate_torques(model, qs, qds, np.zeros_like(qs), chi, model.gravity, None)
    masses = mass_matrix(model, qs, parameters=chi.reshape(-1))
    try:
        np.linalg.cholesky(masses)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(masses)[:, 0]
        worst = int(np.argmin(smallest))
        raise InertiaError(
            f"the mass matrix of {model.name} is not positive definite: smallest eigenvalue"
            f" {smallest[worst]:.3g} at sample {worst}; check the inertias of the links; every"
            " joint must move some, for armatures of drives are not part of the rigid bodies"
            " (run_free has them)"
        ) from None
    return np.reshape(np.linalg.solve(masses, (taus - bias)[:, :, None]), np.shape(q))


def kinetic_energy(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, *, parameters: ArrayLike | None = None
) -> Array:
    """Return `qd^T M(q) qd / 2` [J], shape () or (n_samples,)."""
    qs, qds = shape_joint_samples(model, q=q, qd=qd)
    energy = 0.5 * np.einsum(
        "si,sij,sj->s", qds, mass_matrix(model, qs, parameters=parameters), qds
    )
    return np.reshape(energy, np.shape(q)[:-1])


def potential_energy(
    model: RobotModel, q: ArrayLike, *, parameters: ArrayLike | None = None
) -> Array:
    """Return `-sum_i gravity . (m_i p_i + R_i h_i)` [J], zero with all mass at the root origin.

    Shape () or (n_samples,).
    """
    (qs,) = shape_joint_samples(model, q=q)
    chi = inertial_parameters(model, parameters)
    poses = link_poses(model, qs)
    moments = (
        np.einsum("siab,ib->sia", poses[..., :3, :3], chi[:, 6:9])
        + poses[..., :3, 3] * chi[:, 9:10]
    )
    return np.reshape(-moments.sum(axis=1) @ model.gravity, np.shape(q)[:-1])


Row = tuple[int, int, float]
"""Operation, joint and constant."""


def compile_drives(drive: DriveSet, values: Array, shares: Array) -> tuple[Indices, Array]:
    """Return a program that adds the drive torques of all joints, and its constants.

    `values` (n columns_per_joint,) are the drive parameters joint by joint, `shares` (n, n) the
    `motor_shares` of the robot. The program has rows of operation, joint and place of a constant.
    """
    n = len(shares)
    rows = list[Row]()
    for k, own in enumerate(values.reshape(n, -1)):
        left = own.tolist()
        for term in drive.at(k).terms:
            acts_on = shares[k] if term.of_motor else np.eye(n)[k]
            stated = {number.name: term.value(number.name) for number in term.nonlinear}
            for column in term.columns:
                value = left.pop(0)
                if value and term.is_at(k) and acts_on.any():
                    rows += _write_column_rows(column, stated, acts_on)
                    acting = [(ACT, int(j), value * acts_on[j]) for j in np.flatnonzero(acts_on)]
                    rows += [*acting[:-1], (SPEND, *acting[-1][1:])]
    constants = dict.fromkeys(constant for _, _, constant in rows)
    places = {constant: place for place, constant in enumerate(constants)}
    program = [(operation, joint, places[constant]) for operation, joint, constant in rows]
    return np.array(program, dtype=np.int64).reshape(-1, 3), np.array(list(constants), dtype=float)


def _write_column_rows(column: str, stated: Mapping[str, float], acts_on: Array) -> list[Row]:
    """Return the rows that leave the value of a column on the stack."""

    def number(value: float) -> list[Row]:
        return [(NUMBER, 0, value)]

    def name(text: str) -> list[Row]:
        if text not in STATE:
            return number(stated[text])
        rows = list[Row]()
        for j in np.flatnonzero(acts_on):
            rows += [(OPERATIONS.index(text), int(j), 0.0)]
            rows += (
                [] if acts_on[j] == 1.0 else [(NUMBER, 0, float(acts_on[j])), (MULTIPLY, 0, 0.0)]
            )
            rows += [] if j == np.flatnonzero(acts_on)[0] else [(ADD, 0, 0.0)]
        return rows

    def apply(operation: str, *parts: list[Row]) -> list[Row]:
        return [*(row for part in parts for row in part), (OPERATIONS.index(operation), 0, 0.0)]

    return Formula(column).fold(number, name, apply)


class OneSample:
    """Evaluate a robot for one sample at a time.

    Each method returns None unless its arguments are arrays (n,) of finite float64, and for robots
    with joints that follow others; the caller then takes the general road, which converts or
    raises.
    """

    __slots__ = ("_codes", "_general", "_mass", "_n", "_numbers", "_program", "_still", "_torque")

    def __init__(
        self, model: RobotModel, drive: DriveSet, values: Array, parameters: Array
    ) -> None:
        self._general = model.tree is not model
        if self._general:
            return
        layout = build_layout(model)
        n = model.n_joints
        program, constants = compile_drives(drive, values, model.motor_shares)
        links = np.hstack([layout.placements, parameters.reshape(n, 10)]).ravel()
        self._n = n
        self._still = np.zeros(n)
        self._codes = layout.codes.ravel().copy()
        self._program = np.concatenate([self._codes, program.ravel()])
        work = np.zeros(single_sample.work_size(n))
        self._numbers = np.concatenate([links, layout.gravity, constants, work])
        self._torque = single_sample.torque
        self._mass = single_sample.mass_matrix

    def torque(self, q: Any, qd: Any, qdd: Any) -> Array | None:
        """Return the torques of rigid bodies and drives [N m or N], shape (n,)."""
        if self._general:
            return None
        out = np.empty(self._n)
        try:
            return out if self._torque(self._program, self._numbers, q, qd, qdd, out) else None
        except TypeError:
            return None

    def gravity(self, q: Any) -> Array | None:
        """Return the torques that hold the rigid bodies at rest [N m or N], shape (n,)."""
        if self._general:
            return None
        out = np.empty(self._n)
        still = self._still
        try:
            return out if self._torque(self._codes, self._numbers, q, still, still, out) else None
        except TypeError:
            return None

    def mass_matrix(self, q: Any) -> Array | None:
        """Return the mass matrix of the rigid bodies, shape (n, n)."""
        if self._general:
            return None
        out = np.zeros((self._n, self._n))
        try:
            return out if self._mass(self._codes, self._numbers, q, out) else None
        except TypeError:
            return None


@lru_cache(maxsize=16)
def compile_rigid_bodies(model: RobotModel) -> OneSample:
    """Return the rigid bodies of a robot, remembered for the robots used last."""
    return OneSample(model, NO_DRIVE, np.empty(0), model.parameters)
