"""Simulated trajectories and their derivatives by parameters and start, branch by branch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, drive_columns, inverse_dynamics
from asbuilt.dynamics.kernels.recursion import build_layout
from asbuilt.dynamics.kernels.single_sample import work_size
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.newton_euler import compile_drives
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.identification.trajectories.simulated_robot import SimulatedRobot
from asbuilt.identification.trajectories.stepping import SLOWEST, sensitivities, simulate
from asbuilt.identification.trajectories.windows import Windows

IN_MATRICES = ("armature", "viscous", "motor_armature", "motor_viscous")
"""Drive terms that enter the equations of motion as constant matrices."""
SMALL = 1e-6
"""Step of finite differences of drive terms [rad, rad/s]."""


class Motion(NamedTuple):
    """Hold the simulated motion of W windows at every step.

    `q` and `v` have shape (W, S + 1, n), `a` and `state` (W, S, n), as in `stepping.simulate`.
    """

    q: Array
    v: Array
    a: Array
    state: Array

    def sampled(self, every: int) -> Array:
        """Return the positions at the samples, the first included, shape (W, L, n)."""
        return self.q[:, ::every]

    def replaced(self, at: Indices, part: Motion) -> Motion:
        """Return the motion with some windows replaced."""
        found = Motion(*(x.copy() for x in self))
        for own, new in zip(found, part, strict=True):
            own[at] = new
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """Name the joints (m,) of a branch and the parameters (p,) on which its motion depends.

    Parameters are columns of `(base parameters, kp of each joint, kd of each joint, delay, lead)`;
    the lead is one that all joints have more.
    """

    joints: Indices
    parameters: Indices


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Simulate windows of a robot, and derive the motion by its parameters.

    The parameters are its base parameters, then kp and kd of every joint, then delay and lead.
    """

    model: RobotModel
    base: BaseParameters

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return self.base.n_base + 2 * self.model.n_joints + 2

    @cached_property
    def plan(self) -> RegressorPlan:
        """The regressor columns of links among the base parameters."""
        links = 10 * self.model.n_links
        return RegressorPlan.of(self.model, columns=self.base.columns[self.base.columns < links])

    @cached_property
    def branches(self) -> tuple[Branch, ...]:
        """The branches of the robot, which move independently of each other."""
        n = self.model.n_joints
        p = self.base.n_base
        moved_by = np.array(self.model.link_joints)
        roots = np.arange(n)
        shares = self.model.link_shares != 0.0
        for link in range(self.model.n_links):
            joints = np.flatnonzero(shares[list(self.model.ancestors(link))].any(axis=0))
            roots[np.isin(roots, roots[joints])] = roots[joints].min()
        links = 10 * self.model.n_links
        per = max(self.base.drive.columns_per_joint, 1)
        owner = np.where(
            self.base.columns < links,
            moved_by[np.minimum(self.base.columns, links - 1) // 10],
            (self.base.columns - links) // per,
        )
        found = []
        for root in np.unique(roots):
            joints = np.flatnonzero(roots == root)
            own = np.flatnonzero(roots[owner] == root)
            servo = [p + joints, p + n + joints, [p + 2 * n, p + 2 * n + 1]]
            found.append(Branch(joints, np.concatenate([own, *servo]).astype(np.int64)))
        return tuple(found)

    def simulate(self, robot: SimulatedRobot, windows: Windows, links: Array) -> Motion:
        """Simulate windows; `links` (10 n_links,) are inertial parameters, consistent or not."""
        shape = (windows.n_windows, windows.n_steps, self.model.n_joints)
        q, v = (np.empty((shape[0], shape[1] + 1, shape[2])) for _ in range(2))
        q[:, 0] = windows.start_q
        v[:, 0] = windows.start_qd
        a = np.empty(shape)
        state = np.empty(shape)
        codes, program, numbers = self._compile_program(robot, links)
        simulate(
            codes,
            program,
            numbers,
            *self._shares,
            *_build_matrices(robot),
            *robot.stiffness,
            *robot.deviations,
            windows.signal.kind == "command",
            np.ascontiguousarray(windows.inputs(robot.delay, robot.lead)),
            windows.step,
            q,
            v,
            a,
            state,
        )
        return Motion(q, v, a, state)

    def derivatives(
        self,
        robot: SimulatedRobot,
        windows: Windows,
        links: Array,
        motion: Motion,
        needed: Mask | None = None,
    ) -> Iterator[tuple[Branch, slice, Array]]:
        """Yield for each branch and chunk of windows the derivatives of the positions.

        Shape (windows, L - 1, m, p + 2 m), at the samples after the start, by the parameters and
        then by position and velocity of each joint at the start. A branch has its parameters that
        are `needed` (n_parameters,); None: all.
        """
        if needed is None:
            needed = np.ones(self.n_parameters, dtype=np.bool_)
        branches = tuple(
            replace(branch, parameters=branch.parameters[needed[branch.parameters]])
            for branch in self.branches
        )
        n = self.model.n_joints
        most = max(len(branch.parameters) + 2 * len(branch.joints) for branch in branches)
        size = windows.n_steps * n * (3 * n + most)
        # Numbers held at once by the derivatives of a chunk of windows.
        chunk = max(1, int(3e7 / size))
        for start in range(0, windows.n_windows, chunk):
            part = slice(start, start + chunk)
            own = Motion(*(x[part] for x in motion))
            found = self._differentiate(robot, windows.some(part), links, own, branches)
            yield from ((branch, part, slopes) for branch, slopes in found)

    def _differentiate(
        self,
        robot: SimulatedRobot,
        windows: Windows,
        links: Array,
        motion: Motion,
        branches: Sequence[Branch],
    ) -> Iterator[tuple[Branch, Array]]:
        n = self.model.n_joints
        shape = motion.a.shape
        q, v, a = (
            np.nan_to_num(x).reshape(-1, n) for x in (motion.q[:, :-1], motion.v[:, :-1], motion.a)
        )
        after = np.nan_to_num(motion.v[:, 1:]).reshape(-1, n)
        added = 0.5 * robot.step * a  # torque by the armature that steps add per damping
        slopes = torque_derivatives(self.model, q, v, a, links[None])[:, 0]
        by_q = np.ascontiguousarray(slopes[..., 0])
        by_v = np.ascontiguousarray(slopes[..., 1])
        mass = np.ascontiguousarray(slopes[..., 2])
        sign = np.sign(motion.state - np.where(motion.state > 2.0, 4.0, 0.0)).reshape(-1, n)
        _add_drive_slopes(robot, robot.drive.without(*IN_MATRICES), q, v, sign, by_q, by_v)
        rows = self.plan.evaluate(q, v, a)
        drive = _build_drive_rows(robot, q, v, after - added, a, sign)
        rotors, damping = _build_matrices(robot)
        kp, kd, _ = robot.stiffness
        dead, falling = robot.deviations
        servo = windows.signal.kind == "command"
        inputs = windows.inputs(robot.delay, robot.lead).reshape(-1, n)
        late = (windows.slopes(robot.delay, robot.lead) if servo else np.zeros(shape)).reshape(
            -1, n
        )
        leads = servo and any(self.n_parameters - 1 in branch.parameters for branch in branches)
        ahead = windows.rates(robot.delay).reshape(-1, n) if leads else late
        free = (motion.state < 2.0).reshape(-1, n)
        error = inputs - q
        acting = error - np.clip(error, -dead, dead)
        stiffness = servo * kp * free * ((acting != 0.0) | (dead == 0.0))
        slope = servo * np.where(free, kd, falling)
        p = self.base.n_base
        links_in_base = np.flatnonzero(self.base.columns < 10 * self.model.n_links)
        for branch in branches:
            columns = np.zeros((len(q), len(branch.joints), len(branch.parameters)))
            place = np.full(self.n_parameters, -1)
            place[branch.parameters] = np.arange(len(branch.parameters))
            for i, k in enumerate(branch.joints.tolist()):
                lo, hi = self.plan.bounds[k]
                to = place[links_in_base[self.plan.support[k]]]
                columns[:, i, to[to >= 0]] = rows[k][: hi - lo][to >= 0].T
                known = [(number, drive[k][c]) for c, number in self._drive_columns(k)]
                if servo:
                    known += [
                        (p + k, -acting[:, k] * free[:, k]),
                        (p + n + k, after[:, k] * free[:, k] - added[:, k]),
                        (p + 2 * n, -stiffness[:, k] * late[:, k]),
                        (p + 2 * n + 1, -stiffness[:, k] * ahead[:, k]),
                    ]
                for number, values in known:
                    if place[number] >= 0:
                        columns[:, i, place[number]] = values
            every = windows.divisions
            m = len(branch.joints)
            width = columns.shape[2]
            out = np.empty((shape[0], shape[1] // every, m, width + 2 * m))
            four = (*shape[:2], n, n)
            sensitivities(
                branch.joints,
                by_q.reshape(four),
                by_v.reshape(four),
                mass.reshape(four),
                rotors,
                damping,
                stiffness.reshape(shape),
                slope.reshape(shape),
                motion.state,
                motion.a,
                columns.reshape(*shape[:2], *columns.shape[1:]),
                windows.step,
                every,
                out,
            )
            yield branch, out

    def _drive_columns(self, k: int) -> list[tuple[int, int]]:
        """Return column of the drive terms and place among the base parameters, for joint k."""
        per = self.base.drive.columns_per_joint
        first = 10 * self.model.n_links
        return [
            (int(column - first - k * per), place)
            for place, column in enumerate(self.base.columns.tolist())
            if per and first + k * per <= column < first + (k + 1) * per
        ]

    @property
    def _shares(self) -> tuple[Indices, Array, Array]:
        """Joint that moves each joint of the tree, its share and offset, three (n_links,).

        Empty for a robot whose joints all have a drive.
        """
        joint_map = self.model.constant_map("simulation of a log")
        if self.model.tree is self.model:
            return np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)
        moved_by = np.argmax(np.abs(joint_map.matrix), axis=1)
        shares = joint_map.matrix[np.arange(len(moved_by)), moved_by]
        return moved_by.astype(np.int64), shares, np.array(joint_map.offset)

    def _compile_program(
        self, robot: SimulatedRobot, links: Array
    ) -> tuple[Indices, Indices, Array]:
        """Return codes of the links, codes with the drive program, and numbers."""
        layout = build_layout(self.model.tree)
        bodies = self.model.joint_map.parameters(links.reshape(-1, 10))
        others = robot.drive.without(*IN_MATRICES)
        program, constants = compile_drives(
            others, robot.values_of(*others.keys).reshape(-1), self.model.motor_shares
        )
        codes = layout.codes.ravel().copy()
        numbers = [
            np.hstack([layout.placements, bodies]).ravel(),
            layout.gravity,
            constants,
            np.zeros(work_size(len(bodies))),
        ]
        return codes, np.concatenate([codes, program.ravel()]), np.concatenate(numbers)


def _build_matrices(robot: SimulatedRobot) -> tuple[Array, Array]:
    """Return armatures, less what steps add to them, and dampings of the drives, as (n, n)."""
    T = robot.model.motor_shares
    armature, damping = (
        np.diag(robot.value_of(key)) + T.T @ np.diag(robot.value_of(f"motor_{key}")) @ T
        for key in ("armature", "viscous")
    )
    added = damping + np.diag(robot.stiffness[1])
    return armature - 0.5 * robot.step * added, damping


def _build_drive_rows(
    robot: SimulatedRobot, q: Array, v: Array, after: Array, a: Array, sign: Array
) -> list[Array]:
    """Return the torque of unit drive parameters of every joint, shape (columns, N) each."""
    shares = robot.model.motor_shares
    drive = robot.drive
    away = np.maximum(np.abs(v), SLOWEST)
    still = np.zeros_like(q)
    load = inverse_dynamics(robot.model, q, v, still) if drive.needs_load else None
    matrix = np.array([term.key in IN_MATRICES for term in drive.terms for _ in term.symbols])
    found = []
    for k in range(q.shape[1]):
        ahead, back = (
            drive_columns(drive, k, q, s * away, still, load=load, shares=shares)
            for s in (1.0, -1.0)
        )
        rows = 0.5 * (ahead + back) + sign[:, k] * 0.5 * (ahead - back)
        rows[matrix] = drive_columns(drive, k, q, after, a, load=load, shares=shares)[matrix]
        found.append(rows)
    return found


def _add_drive_slopes(
    robot: SimulatedRobot,
    others: DriveSet,
    q: Array,
    v: Array,
    sign: Array,
    by_q: Array,
    by_v: Array,
) -> None:
    """Add the derivatives of the drive torques by position and velocity, joint by joint."""
    if not others or set(others.keys) <= {"coulomb", "offset"}:
        return
    values = robot.values_of(*others.keys)
    part = replace(robot, drive=others, values=values)
    for out, moves in ((by_q, (SMALL, 0.0)), (by_v, (0.0, SMALL))):
        two = []
        for s in (1.0, -1.0):
            rows = _build_drive_rows(
                part, q + s * moves[0], v + s * moves[1], v, np.zeros_like(q), sign
            )
            two.append(np.stack([values[k] @ rows[k] for k in range(q.shape[1])], axis=1))
        out[:, range(q.shape[1]), range(q.shape[1])] += (two[0] - two[1]) / (2.0 * SMALL)
