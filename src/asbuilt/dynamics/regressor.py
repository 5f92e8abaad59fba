"""The joint torques as a linear function of the standard parameters, `tau = Y(q, qd, qdd) chi`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import kernels
from asbuilt.dynamics.batches import flat, joint_samples, over_samples
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.parameters import parameter_count
from asbuilt.dynamics.recursion import layout_of
from asbuilt.errors import UsageError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_LINE = 8
_PER_LINK = len(PARAMETER_NAMES)


def _checked_columns(model: RobotModel, drive: DriveSet, columns: ArrayLike | None) -> Indices:
    count = parameter_count(model, drive)
    chosen = np.arange(count) if columns is None else np.array(columns)
    if chosen.ndim != 1 or (chosen.size and not np.issubdtype(chosen.dtype, np.integer)):
        raise UsageError(f"columns must be a list of integers, got shape {chosen.shape} of {chosen.dtype}")
    outside = chosen[(chosen < 0) | (chosen >= count)]
    if outside.size:
        raise UsageError(f"column {outside[0]} does not exist: {model.name} with drive terms {drive} has columns 0 to {count - 1}")
    if np.unique(chosen).size != chosen.size:
        raise UsageError("columns repeat; name each column once")
    return chosen.astype(np.int64)


def joint_support(model: RobotModel, drive: DriveSet, columns: ArrayLike) -> list[Indices]:
    """Return for each joint the positions in `columns` that can be non-zero in its row: links it carries, its own drive terms."""
    chosen, n = _checked_columns(model, drive, columns), model.n_joints
    carried = np.zeros((n, n), dtype=bool)
    for i in range(n):
        carried[list(model.ancestors(i)), i] = True
    links = np.repeat(carried, _PER_LINK, axis=1)
    drives = np.repeat(np.eye(n, dtype=bool), drive.columns_per_joint, axis=1)
    mask = np.concatenate([links, drives], axis=1)
    return [np.flatnonzero(mask[k, chosen]) for k in range(n)]


@dataclass(frozen=True, eq=False)
class RegressorPlan:
    """Prepare what the evaluation of chosen regressor columns needs, once per robot, for millions of samples.

    Rows run joint by joint: `support[k]` columns of joint k, in the order of `columns`, then `spare_rows` that are left to the caller (for the
    torque, say). `bounds[k]` are the first row of joint k and the row after its last, spare rows excluded.

    """

    model: RobotModel
    drive: DriveSet
    columns: Indices
    support: tuple[Indices, ...]
    bounds: Indices
    places: Indices
    spare_rows: int

    @classmethod
    def of(cls, model: RobotModel, drive: DriveSet = NO_DRIVE, columns: ArrayLike | None = None, *, spare_rows: int = 0) -> RegressorPlan:
        """Plan the evaluation of `columns` (zero-based, all where None) of the standard parameters of a robot and its drives."""
        chosen, n = _checked_columns(model, drive, columns), model.n_joints
        support = tuple(joint_support(model, drive, chosen))
        starts = np.cumsum([0, *(positions.size + spare_rows for positions in support)])
        bounds = np.array([(start, start + positions.size) for start, positions in zip(starts, support, strict=False)], dtype=np.int64)
        places = np.full((n, n * _PER_LINK + n * drive.columns_per_joint), -1, dtype=np.int64)
        for k, positions in enumerate(support):
            places[k, chosen[positions]] = np.arange(*bounds[k])
        for array in (chosen, bounds, places, *support):
            array.setflags(write=False)
        return cls(model, drive, chosen, support, bounds, places, spare_rows)

    @property
    def n_rows(self) -> int:
        """Rows of an `out` array: the supports of all joints and the spare rows."""
        return int(self.bounds[-1, 1]) + self.spare_rows

    def buffer(self, n_samples: int) -> Array:
        """Return an uninitialised `out` for up to `n_samples`, aligned and padded so that its rows do not compete for the same cache lines."""
        lines = -(-n_samples // _LINE) | 1
        memory = np.empty(self.n_rows * lines * _LINE + _LINE)
        first = (-(memory.ctypes.data // 8)) % _LINE
        return memory[first : first + self.n_rows * lines * _LINE].reshape(self.n_rows, lines * _LINE)

    def evaluate(self, q: Array, qd: Array, qdd: Array, out: Array | None = None, *, threads: int | None = 1) -> tuple[Array, ...]:
        """Return one view of `out` per joint, shape (n_support_k + spare_rows, n_samples), samples innermost; spare rows are not touched.

        `q, qd, qdd` are float64 (n_samples, n_joints), trusted to be finite. `out` is float64, contiguous, (n_rows, at least n_samples).
        """
        n_samples, n = q.shape[0], self.model.n_joints
        target = self.buffer(n_samples) if out is None else out
        if not q.shape == qd.shape == qdd.shape == (n_samples, n):
            raise UsageError(f"q, qd and qdd must all have shape (n_samples, {n}), got {q.shape}, {qd.shape} and {qdd.shape}")
        if target.shape[0] != self.n_rows or target.shape[1] < n_samples or not target.flags.c_contiguous or target.dtype != np.float64:
            raise UsageError(
                f"out must be contiguous float64 of {self.n_rows} rows and at least {n_samples} columns, got {target.dtype} {target.shape}; "
                "use plan.buffer(n_samples)"
            )
        inputs = tuple(np.ascontiguousarray(array, dtype=np.float64) for array in (q, qd, qdd))
        layout, places = layout_of(self.model), self._link_places
        vectors, rows = [flat(array) for array in inputs], target.reshape(-1)

        def work(start: int, stop: int) -> None:
            kernels.regressor_rows(
                layout.codes,
                layout.chain,
                layout.placements,
                layout.gravity,
                layout.n_slots,
                places,
                self.bounds,
                *vectors,
                start,
                stop,
                rows,
                target.shape[1],
            )

        over_samples(work, n_samples, threads)
        if self.drive:
            self._write_drives(*inputs, target)
        return tuple(target[first : stop + self.spare_rows, :n_samples] for first, stop in self.bounds.tolist())

    def stack(self, q: Array, qd: Array, qdd: Array, *, threads: int | None = None) -> Array:
        """Return the observation matrix, sample-major, shape (n_samples n_joints, n_columns); inputs as in `evaluate`."""
        n_samples, n = q.shape
        matrix = np.zeros((n_samples * n, self.columns.size))
        layout, places = layout_of(self.model), self._link_places
        vectors, out = [flat(np.ascontiguousarray(array, dtype=np.float64)) for array in (q, qd, qdd)], matrix.reshape(-1)
        order = np.zeros(self.n_rows, dtype=np.int64)
        for (first, stop), positions in zip(self.bounds.tolist(), self.support, strict=True):
            order[first:stop] = positions

        def work(start: int, stop: int) -> None:
            kernels.regressor_stack(
                layout.codes,
                layout.chain,
                layout.placements,
                layout.gravity,
                layout.n_slots,
                places,
                self.bounds,
                order,
                *vectors,
                start,
                stop,
                out,
                matrix.shape[1],
            )

        over_samples(work, n_samples, threads)
        load = inverse_dynamics(self.model, q, qd, qdd) if self.drive.needs_load else None
        for k, (wanted, rows) in enumerate(self._drive_rows):
            if rows.size:
                columns = self.drive.evaluate(q[:, k], qd[:, k], qdd[:, k], None if load is None else load[:, k])
                matrix.reshape(n_samples, n, -1)[:, k, order[rows]] = columns[wanted].T
        return matrix

    @property
    def _link_places(self) -> Indices:
        n = self.model.n_joints
        return self.places[:, : n * _PER_LINK].reshape(n, n, _PER_LINK)

    @property
    def _drive_rows(self) -> tuple[tuple[Indices, Indices], ...]:
        """For each joint which drive columns are wanted, and the row of each."""
        n, per = self.model.n_joints, self.drive.columns_per_joint
        found = []
        for k in range(n):
            rows = self.places[k, n * _PER_LINK + k * per : n * _PER_LINK + (k + 1) * per]
            wanted = np.flatnonzero(rows >= 0)
            found.append((wanted, rows[wanted]))
        return tuple(found)

    def _write_drives(self, q: Array, qd: Array, qdd: Array, target: Array) -> None:
        n_samples, per = q.shape[0], self.drive.columns_per_joint
        load = inverse_dynamics(self.model, q, qd, qdd) if self.drive.needs_load else None
        for k, (wanted, rows) in enumerate(self._drive_rows):
            if not rows.size:
                continue
            signals = q[:, k], qd[:, k], qdd[:, k], None if load is None else load[:, k]
            if wanted.size == per and np.array_equal(rows, np.arange(rows[0], rows[0] + per)):
                self.drive.evaluate(*signals, out=target[rows[0] : rows[0] + per, :n_samples])
            else:
                target[rows, :n_samples] = self.drive.evaluate(*signals)[wanted]


@lru_cache(maxsize=16)
def _plan(model: RobotModel, drive: DriveSet, columns: tuple[int, ...] | None) -> RegressorPlan:
    return RegressorPlan.of(model, drive, columns)


def _planned(model: RobotModel, drive: DriveSet, columns: ArrayLike | None) -> RegressorPlan:
    return _plan(model, drive, None if columns is None else tuple(np.asarray(columns).tolist()))


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
    """Stack the regressors of all samples, sample-major: row `n_joints s + k` is joint k at sample s, shape (n_samples n_joints, n_columns).

    `columns` (zero-based) chooses among the standard parameters, those of the links first, then those of the drives joint by joint; None takes all.
    """
    return _planned(model, drive, columns).stack(*joint_samples(model, q=q, qd=qd, qdd=qdd), threads=threads)


def regressor(model: RobotModel, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, drive: DriveSet = NO_DRIVE) -> Array:
    """Return Y of one sample, shape (n_joints, n_standard): `Y parameter_values(model, drive)` is the torque of the bodies and the drives.

    Source: Atkeson, An and Hollerbach (1986). Raises UsageError for more than one sample; see `observation_matrix`.
    """
    if np.shape(q) != (model.n_joints,):
        raise UsageError(f"q must be one sample of shape ({model.n_joints},), got {np.shape(q)}; observation_matrix takes many")
    return observation_matrix(model, q, qd, qdd, drive=drive)


def joint_observations(
    model: RobotModel, drive: DriveSet, columns: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, out: Array | None = None
) -> list[Array]:
    """Return the rows of each joint without structural zeros, samples innermost: shape (n_support_k, n_samples) for joint k.

    `joint_support` says which columns they are. `out` is reused memory from `RegressorPlan.buffer`; for millions of samples keep a `RegressorPlan`.
    """
    return list(_planned(model, drive, columns).evaluate(*joint_samples(model, q=q, qd=qd, qdd=qdd), out))
