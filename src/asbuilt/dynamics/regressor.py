"""The joint torques as a linear function of the standard parameters, `tau = Y(q, qd, qdd) chi`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.joint_map import JointMap
from asbuilt.dynamics.batches import flatten_array, run_over_samples, shape_joint_samples
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.dynamics.drives.torque import drive_columns
from asbuilt.dynamics.kernels import rigid_body
from asbuilt.dynamics.kernels.recursion import build_layout
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.parameters import parameter_count
from asbuilt.errors import UsageError

Some = slice | Indices

NO_COLUMNS = np.empty(0, dtype=np.int64)
"""Of the regressor kernel, which then writes one row per joint and parameter."""
_LINE = 8
"""Doubles in a cache line."""
_PER_LINK = len(PARAMETER_NAMES)


def _simplify_indices(indices: Indices) -> Some:
    """Return increasing neighbours as a slice, which copies faster."""
    if indices.size and np.all(np.diff(indices) == 1):
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices


def _check_columns(model: RobotModel, drive: DriveSet, columns: ArrayLike | None) -> Indices:
    count = parameter_count(model, drive)
    chosen = np.arange(count) if columns is None else np.array(columns)
    if chosen.ndim != 1 or (chosen.size and not np.issubdtype(chosen.dtype, np.integer)):
        raise UsageError(
            f"columns must be a list of integers, got shape {chosen.shape} of {chosen.dtype}"
        )
    outside = chosen[(chosen < 0) | (chosen >= count)]
    if outside.size:
        raise UsageError(
            f"column {outside[0]} does not exist: {model.name} with drive terms {drive} has columns"
            f" 0 to {count - 1}"
        )
    if np.unique(chosen).size != chosen.size:
        raise UsageError("columns repeat; name each column once")
    return chosen.astype(np.int64)


def find_joint_support(model: RobotModel, drive: DriveSet, columns: ArrayLike) -> list[Indices]:
    """Return for each joint the positions in `columns` that can be non-zero in its row.

    Links it carries, its own drive, motors it turns; all where reactions are projected away, which
    mixes the rows.
    """
    chosen = _check_columns(model, drive, columns)
    n = model.n_joints
    if model.has_reactions:
        return [np.arange(chosen.size)] * n
    moved_by = model.link_shares != 0.0
    carried = np.zeros((n, model.n_links), dtype=bool)
    for i in range(model.n_links):
        carried[:, i] = moved_by[list(model.ancestors(i))].any(axis=0)
    links = np.repeat(carried, _PER_LINK, axis=1)
    turning = np.where(
        drive.of_motor, (model.motor_shares.T != 0.0)[:, :, None], np.eye(n, dtype=bool)[:, :, None]
    )
    mask = np.concatenate([links, turning.reshape(n, -1)], axis=1)
    return [np.flatnonzero(mask[k, chosen]) for k in range(n)]


@lru_cache(maxsize=16)
def _find_moving_coordinates(model: RobotModel) -> Mask:
    """Return which coordinates move which links of the tree, (n_links + 1, n), the root first."""
    tree = model.tree
    shares = model.link_shares[list(model.link_order)] != 0.0
    moves = np.zeros((model.n_links + 1, model.n_joints), dtype=bool)
    for i in range(model.n_links):
        moves[i + 1] = shares[list(tree.ancestors(i))].any(axis=0)
    moves.setflags(write=False)
    return moves


@dataclass(frozen=True, eq=False)
class TreeRows:
    """Hold which rows of the joints of all links make up the rows of the coordinates.

    By virtual work `Y = G^T Y_tree`. `plan` evaluates the rows of the tree. Each of `sums` is a
    joint i of the tree and a coordinate k, with rows of the tree (m,), and the rows of the plan
    (m,) to which their product with `G[i, k]` counts.
    """

    joint_map: JointMap
    plan: RegressorPlan
    sums: tuple[tuple[int, int, Indices, Indices], ...]

    @classmethod
    def of(cls, model: RobotModel, chosen: Indices, rows: Indices) -> TreeRows:
        """Return the rows for the columns `chosen`, whose rows in joint k are `rows[k]`."""
        joint_map = model.joint_map
        inertial = chosen[chosen < _PER_LINK * model.n_links]
        link, parameter = np.divmod(inertial, _PER_LINK)
        plan = RegressorPlan.of(
            model.tree, columns=_PER_LINK * np.argsort(joint_map.order)[link] + parameter
        )
        sums = []
        for k in range(model.n_joints):
            for i in np.flatnonzero(joint_map.of_links[joint_map.order, k]).tolist():
                own = np.arange(*plan.bounds[i])
                sums.append((i, k, own, rows[k, inertial[plan.support[i]]]))
        return cls(joint_map, plan, tuple(sums))

    def weights(self, weights: Array, shares: Array, n_samples: int) -> Array:
        """Return weights of the tree's rows for weights of the plan's: the adjoint of `G^T`."""
        found = np.zeros((self.plan.n_rows, n_samples))
        for i, k, own, rows in self.sums:
            found[own] += shares[..., i, k] * weights[rows, :n_samples]
        return found

    def evaluated(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the rows of the tree for the motion of its joints."""
        out = self.plan.buffer(len(q))
        self.plan.evaluate(q, qd, qdd, out)
        return out

    def torn(self, weights: Array, of_tree: Array, n_samples: int) -> Array:
        """Return the derivative by `G` (N, n_links, n) of the weighted rows; `of_tree` theirs."""
        found = np.zeros((n_samples, *self.joint_map.of_links.shape))
        for i, k, own, rows in self.sums:
            found[:, i, k] = np.einsum(
                "rs,rs->s", of_tree[own, :n_samples], weights[rows, :n_samples]
            )
        return found


@dataclass(frozen=True, eq=False)
class RegressorPlan:
    """Plan the evaluation of chosen regressor columns, once for any number of samples.

    Made by `RegressorPlan.of`.

    Rows run joint by joint: the `support[k]` columns of joint k, in the order of `columns`, then
    `spare_rows` that are left to the caller (for the torque, say). `bounds[k]` are the first row of
    joint k and the row after its last, spare rows excluded. `places[k, i, c]` is the row for joint
    k and parameter c of link i, -1 where it was not chosen; `drive_rows[k]` are the chosen among
    the drive columns of joint k in its own torque, and their rows; `motor_rows` lists (motor,
    column, joint, row) for motors that several joints turn. `tree` are the rows by the
    joints of the links, of which virtual work makes the rows of the coordinates; None where each
    coordinate is a joint.

    >>> from asbuilt.description.load import load_robot
    >>> plan = RegressorPlan.of(load_robot("kuka-iiwa7-r800"), columns=range(60, 70))
    >>> q = np.zeros((1000, 7))
    >>> [rows.shape for rows in plan.evaluate(q, q, q)] == [(10, 1000)] * 7
    True
    """

    model: RobotModel
    drive: DriveSet
    columns: Indices
    spare_rows: int
    support: tuple[Indices, ...]
    bounds: Indices
    places: Indices
    drive_rows: tuple[tuple[Some, Some], ...]
    motor_rows: tuple[tuple[int, int, int, int], ...] = ()
    tree: TreeRows | None = None

    @classmethod
    def of(
        cls,
        model: RobotModel,
        drive: DriveSet = NO_DRIVE,
        columns: ArrayLike | None = None,
        *,
        spare_rows: int = 0,
    ) -> RegressorPlan:
        """Plan the evaluation of `columns` of the standard parameters of a robot and its drives.

        They count from 0; None takes all.
        """
        chosen = _check_columns(model, drive, columns)
        n = model.n_joints
        per = drive.columns_per_joint
        support = tuple(find_joint_support(model, drive, chosen))
        starts = np.cumsum([0, *(positions.size + spare_rows for positions in support)])
        bounds = np.array(
            [
                (start, start + positions.size)
                for start, positions in zip(starts, support, strict=False)
            ],
            dtype=np.int64,
        )
        rows = np.full((n, parameter_count(model, drive)), -1, dtype=np.int64)
        for k, positions in enumerate(support):
            rows[k, chosen[positions]] = np.arange(*bounds[k])
        first = model.n_links * _PER_LINK
        places = rows[:, :first].reshape(n, model.n_links, _PER_LINK).copy()
        drives = rows[:, first:].reshape(n, n, per)
        of_motor = drive.of_motor
        own = [np.where(of_motor, -1, drives[k, k]) for k in range(n)]
        drive_rows = tuple(
            (_simplify_indices(np.flatnonzero(row >= 0)), _simplify_indices(row[row >= 0]))
            for row in own
        )
        motor_rows = tuple(
            (int(m), int(c), int(k), int(drives[k, m, c]))
            for k, m, c in np.argwhere((drives >= 0) & of_motor[None, None, :]).tolist()
        )
        for array in (chosen, bounds, places, *support):
            array.setflags(write=False)
        return cls(
            model,
            drive,
            chosen,
            spare_rows,
            support,
            bounds,
            places,
            drive_rows,
            motor_rows,
            None if model.tree is model else TreeRows.of(model, chosen, rows),
        )

    @property
    def n_rows(self) -> int:
        """Rows of an `out` array: the supports of all joints and the spare rows."""
        return int(self.bounds[-1, 1]) + self.spare_rows

    def buffer(self, n_samples: int) -> Array:
        """Return an uninitialised `out` for up to `n_samples`.

        It is aligned and padded so that rows do not compete for the same cache lines.
        """
        width = (-(-n_samples // _LINE) | 1) * _LINE
        memory = np.empty(self.n_rows * width + _LINE)
        first = (-(memory.ctypes.data // memory.itemsize)) % _LINE
        return memory[first : first + self.n_rows * width].reshape(self.n_rows, width)

    def evaluate(
        self, q: Array, qd: Array, qdd: Array, out: Array | None = None, *, threads: int | None = 1
    ) -> tuple[Array, ...]:
        """Return one view of `out` per joint, shape (n_support_k + spare_rows, n_samples).

        Samples are innermost; spare rows are not touched.

        `q, qd, qdd` are (n_samples, n_joints), trusted to be finite. `out` is contiguous, (n_rows,
        at least n_samples), best from `buffer`; the views are good until the next call with it. The
        numbers depend neither on `threads` nor on how a recording is cut into calls. Raises
        UsageError for shapes that do not fit.
        """
        inputs = self.checked_inputs(q, qd, qdd)
        n_samples = inputs[0].shape[0]
        target = self.buffer(n_samples) if out is None else out
        if (
            target.shape[0] != self.n_rows
            or target.shape[1] < n_samples
            or not target.flags.c_contiguous
            or target.dtype != np.float64
        ):
            raise UsageError(
                f"out must be contiguous float64 of {self.n_rows} rows and at least {n_samples}"
                f" columns, got {target.dtype} {target.shape}; use plan.buffer(n_samples)"
            )
        if self.model.has_reactions:
            target[...] = 0.0  # every joint has all rows, and kernels write those that can be other
        self._write(inputs, target, NO_COLUMNS, threads)
        for _, rows_of_drive, columns in self._yield_drive_columns(*inputs):
            target[rows_of_drive, :n_samples] = columns
        return self.joint_rows(target, n_samples)

    def _write(
        self, inputs: Sequence[Array], target: Array, columns: Indices, threads: int | None
    ) -> None:
        """Write the rows of the links for checked states into `target`, as the kernels do."""
        if not self.columns.size or self.columns.min() >= _PER_LINK * self.model.n_links:
            return
        joint_map = self.model.joint_map
        places = joint_map.parameters(self.places)
        moved = joint_map.motion(*inputs)
        layout = build_layout(self.model.tree)
        moves = _find_moving_coordinates(self.model)
        robot = layout.codes, layout.placements, layout.gravity, layout.n_slots
        vectors = [flatten_array(array) for array in (moved.q, moved.qd, moved.qdd)]
        rows = target.reshape(-1)
        width = target.shape[1]

        def work(start: int, stop: int) -> None:
            rigid_body.regressor(
                *robot,
                flatten_array(moved.shares),
                moves,
                places,
                self.bounds,
                columns,
                *vectors,
                start,
                stop,
                rows,
                width,
            )

        run_over_samples(work, inputs[0].shape[0], threads)

    def joint_rows(self, out: Array, n_samples: int) -> tuple[Array, ...]:
        """Return the rows of each joint, the spare ones too, as views of the first samples."""
        return tuple(
            out[first : stop + self.spare_rows, :n_samples] for first, stop in self.bounds.tolist()
        )

    def stack(self, q: Array, qd: Array, qdd: Array, *, threads: int | None = 1) -> Array:
        """Return the observation matrix, sample-major, shape (n_samples n_joints, n_columns).

        Inputs as in `evaluate`.
        """
        inputs = self.checked_inputs(q, qd, qdd)
        n_samples, n = inputs[0].shape
        order = np.zeros(self.n_rows, dtype=np.int64)
        for (first, stop), positions in zip(self.bounds.tolist(), self.support, strict=True):
            order[first:stop] = positions
        matrix = np.zeros((n_samples * n, self.columns.size))
        self._write(inputs, matrix, order, threads)
        for k, rows_of_drive, columns in self._yield_drive_columns(*inputs):
            matrix.reshape(n_samples, n, matrix.shape[1])[:, k, order[rows_of_drive]] = columns.T
        return matrix

    def checked_inputs(self, *arrays: Array) -> tuple[Array, ...]:
        """Return q, qd and qdd as contiguous doubles.

        Raises UsageError where they are not all (n_samples, n_joints).
        """
        shapes = [array.shape for array in arrays]
        if len(set(shapes)) > 1 or len(shapes[0]) != 2 or shapes[0][1] != self.model.n_joints:
            raise UsageError(
                f"q, qd and qdd must all have shape (n_samples, {self.model.n_joints}), got"
                f" {', '.join(map(str, shapes))}"
            )
        return tuple(np.ascontiguousarray(array, dtype=np.float64) for array in arrays)

    def _yield_drive_columns(
        self, q: Array, qd: Array, qdd: Array
    ) -> Iterator[tuple[int, Some | int, Array]]:
        """Yield joint, rows and values of the chosen drive columns.

        The joint is that whose torque they enter.
        """
        if not self.drive:
            return
        load = inverse_dynamics(self.model, q, qd, qdd) if self.drive.needs_load else None
        shares = self.model.motor_shares if self.motor_rows else None
        q, qd, qdd = (np.asfortranarray(values) for values in (q, qd, qdd))
        columns = np.empty((self.drive.columns_per_joint, q.shape[0]))
        for k, (chosen, rows) in enumerate(self.drive_rows):
            drive_columns(self.drive, k, q, qd, qdd, load=load, shares=shares, out=columns)
            yield k, rows, columns[chosen]
            for motor, column, joint, row in self.motor_rows:
                if motor == k and shares is not None:
                    yield joint, row, shares[k, joint] * columns[column]


@lru_cache(maxsize=16)
def _make_plan(
    model: RobotModel, drive: DriveSet, columns: tuple[int, ...] | None
) -> RegressorPlan:
    return RegressorPlan.of(model, drive, columns)


def observation_matrix(
    model: RobotModel,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    *,
    drive: DriveSet = NO_DRIVE,
    columns: ArrayLike | None = None,
    threads: int | None = None,
) -> Array:
    """Stack the regressors of all samples, sample-major.

    Row `n_joints s + k` is joint k at sample s, shape (n_samples n_joints, n_columns).

    `columns` (zero-based) chooses among the standard parameters, the links' first, then
    the drives' joint by joint; None takes all.
    """
    qs, qds, qdds = shape_joint_samples(model, q=q, qd=qd, qdd=qdd)
    chosen = None if columns is None else tuple(np.asarray(columns).tolist())
    return _make_plan(model, drive, chosen).stack(qs, qds, qdds, threads=threads)


def regressor(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, drive: DriveSet = NO_DRIVE
) -> Array:
    """Return Y of one sample, shape (n_joints, n_standard).

    `Y parameter_values(model, drive)` is the torque of the bodies and the drives.

    Source: Atkeson, An and Hollerbach (1986). Raises UsageError for more than one sample; see
    `observation_matrix`.
    """
    if np.shape(q) != (model.n_joints,):
        raise UsageError(
            f"q must be one sample of shape ({model.n_joints},), got {np.shape(q)};"
            " observation_matrix takes many"
        )
    return observation_matrix(model, q, qd, qdd, drive=drive)
