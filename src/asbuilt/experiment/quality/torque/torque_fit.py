"""Comparison of measured torques with the model's, and the order of columns that fits best."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TypeVar

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import spring_columns
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.quality.reductions import SmoothedMotion

T = TypeVar("T")


def choose_decisive_change(
    logged: T, changes: Iterable[T], cost: Callable[[T], float], fall: float
) -> T | None:
    """Return the cheapest of `changes` if it costs less than `logged` by more than `fall`.

    Parameters
    ----------
    logged
        Order of columns as logged.
    changes
        Other orders, such as the orders of `list_swaps`.
    cost
        Misfit of an order.
    fall
        Difference of the costs from which the change is decisive.
    """
    costs = [(cost(change), change) for change in changes]
    best = min(costs, key=lambda pair: pair[0], default=None)
    return best[1] if best is not None and best[0] < cost(logged) - fall else None


def list_swaps(order: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield the orders with two entries swapped.

    >>> list(list_swaps((0, 1, 2)))
    [(1, 0, 2), (2, 1, 0), (0, 2, 1)]
    """
    for i, j in combinations(range(len(order)), 2):
        changed = list(order)
        changed[i], changed[j] = order[j], order[i]
        yield tuple(changed)


BREAKAWAY = 0.02
"""Width of the smoothed sign of velocity [rad/s or m/s]."""


@dataclass(frozen=True, slots=True)
class AssignmentThresholds:
    """Decide from the sum over joints of the logarithm of the misfit."""

    floor: float = 0.02
    """Misfit below which a better fit does not count."""
    fall: float = 2.0
    """Fall of the sum from which a swap is decisive: one misfit falls to an eighth."""
    correlation: float = 0.9
    """Correlation that one of the swapped joints must reach."""
    most_samples: int = 400
    """Number of samples used; more do not change the decision."""
    most_joints: int = 10
    """Number of joints above which swapped motions are not searched, for time."""


THRESHOLDS = AssignmentThresholds()


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Compare torque columns with the model's rigid-body torques.

    `motion_of[k]` and `torque_of[k]` are the columns taken for joint k. Measured y_k and predicted
    x_k are the residuals of each after a fit of 1, qd_k and tanh(qd_k / 0.02): offset and friction
    are taken out of both, and so are described springs. `friction` are the `friction_bases`.
    """

    model: RobotModel
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    friction: Array
    motion_of: tuple[int, ...]
    torque_of: tuple[int, ...]

    @classmethod
    def of(
        cls, model: RobotModel, motion: SmoothedMotion, scale: Array, torque_scale: float = 1.0
    ) -> TorqueFit:
        """Compare a smoothed motion, positions times `scale` (n,), in the order logged."""
        rows = motion.thinned(THRESHOLDS.most_samples)
        order = tuple(range(model.n_joints))
        qd = motion.qd[rows] * scale
        return cls(
            model,
            motion.q[rows] * scale,
            qd,
            motion.qdd[rows] * scale,
            motion.tau[rows] * torque_scale,
            friction_bases(qd, spring_columns(model, motion.q[rows] * scale)),
            order,
            order,
        )

    @cached_property
    def _residuals(self) -> tuple[Array, Array]:
        pick = list(self.motion_of)
        qd = self.qd[:, pick]
        x = inverse_dynamics(self.model, self.q[:, pick], qd, self.qdd[:, pick], threads=1)
        return self.without_friction(x), self.without_friction(self.tau[:, list(self.torque_of)])

    def without_friction(self, torque: Array) -> Array:
        """Return torques (N, n) without what offset and friction of each joint explain."""
        bases, columns = self.friction[list(self.motion_of)], torque.T[:, :, None]
        rest = columns - bases @ (bases.swapaxes(1, 2) @ columns)
        return np.ascontiguousarray(rest[:, :, 0].T)

    @property
    def predicted(self) -> Array:
        """Standard deviation of the predicted torque of each joint [N m], shape (n,)."""
        return np.asarray(np.std(self._residuals[0], axis=0))

    @property
    def decides(self) -> Mask:
        """Which joints have enough predicted torque to decide anything, shape (n,)."""
        predicted = self.predicted
        # Predicted torque, relative to the largest, below which a joint decides nothing.
        return np.asarray(predicted > 0.02 * np.max(predicted))

    @property
    def gravity(self) -> Array:
        """Standard deviation of the torque of gravity of each joint [N m], shape (n,)."""
        q = self.q[:, list(self.motion_of)]
        still = np.zeros_like(q)
        torque = inverse_dynamics(self.model, q, still, still, threads=1)
        return np.asarray(np.std(self.without_friction(torque), axis=0))

    @property
    def measured(self) -> Array:
        """Standard deviation of the measured torque of each joint [N m], shape (n,)."""
        return np.asarray(np.std(self._residuals[1], axis=0))

    @property
    def correlation(self) -> Array:
        """Correlation of measured with predicted torque, joint by joint, shape (n,)."""
        x, y = self._residuals
        norms = np.linalg.norm(x, axis=0) * np.linalg.norm(y, axis=0)
        return np.asarray(np.sum(x * y, axis=0) / np.where(norms > 0, norms, 1.0))

    @property
    def gain(self) -> Array:
        """Least-squares factor from predicted to measured torque, joint by joint, shape (n,)."""
        x, y = self._residuals
        energy = np.sum(x**2, axis=0)
        return np.asarray(np.sum(x * y, axis=0) / np.where(energy > 0, energy, 1.0))

    @property
    def friction_correlation(self) -> Array:
        """Correlation of each joint's torque with its direction of motion, shape (n,).

        The rigid-body torque of any masses is projected out of both, so CAD values do not matter;
        joints whose friction is less than a tenth of their torque get 0.
        """
        pick = list(self.motion_of)
        base = find_base_parameters(self.model, DriveSet.parse("offset"))
        q, qd, qdd = (values[:, pick] for values in (self.q, self.qd, self.qdd))
        observed = observation_matrix(
            self.model, q, qd, qdd, drive=base.drive, columns=base.columns
        )
        rows = observed.reshape(*q.shape, base.n_base)
        correlation = np.zeros(q.shape[1])
        for k in range(q.shape[1]):
            lengths = np.linalg.norm(rows[:, k], axis=0)
            basis, values, _ = np.linalg.svd(
                rows[:, k, lengths > 0] / lengths[lengths > 0], full_matrices=False
            )
            basis = basis[:, values > 1e-6 * values[0]]
            both = np.column_stack([np.tanh(qd[:, k] / BREAKAWAY), self.tau[:, self.torque_of[k]]])
            direction, rest = (both - basis @ (basis.T @ both)).T
            norm = float(np.linalg.norm(direction) * np.linalg.norm(rest))
            whole = np.linalg.norm(both[:, 1] - both[:, 1].mean())
            if norm > 0 and abs(direction @ rest) / np.linalg.norm(direction) > 0.1 * whole:
                correlation[k] = direction @ rest / norm
        return correlation

    def misfit(self, sign: int) -> Array:
        """Return `|y_k - sign x_k|^2 / (|y_k|^2 + |x_k|^2)` of each joint, shape (n,)."""
        x, y = self._residuals
        scale = np.sum(x**2, axis=0) + np.sum(y**2, axis=0)
        return np.asarray(np.sum((y - sign * x) ** 2, axis=0) / np.where(scale > 0, scale, 1.0))

    @property
    def cost(self) -> float:
        """Sum over joints of the logarithm of the misfit, for the better sign of all torques."""
        return min(float(np.sum(np.log(self.misfit(sign) + THRESHOLDS.floor))) for sign in (1, -1))

    def changes(self) -> Iterator[TorqueFit]:
        """Yield the fits with two joints swapped: their torques, their motions, or both."""
        for torque_of, motion_of in zip(
            list_swaps(self.torque_of), list_swaps(self.motion_of), strict=True
        ):
            yield replace(self, torque_of=torque_of)
            if self.model.n_joints <= THRESHOLDS.most_joints:
                yield replace(self, torque_of=torque_of, motion_of=motion_of)
                yield replace(self, motion_of=motion_of)


def friction_bases(qd: Array, springs: Array) -> Array:
    """Return orthonormal bases (n, N, 3 + m) of friction and of the columns of springs (n, N, m).

    Friction is 1, qd_k and tanh(qd_k / 0.02) for velocities (N, n); dependent columns are zero.
    """
    terms = np.stack([np.ones_like(qd), qd, np.tanh(qd / BREAKAWAY)], axis=-1)
    friction = np.linalg.qr(terms.swapaxes(0, 1))[0]
    if not springs.size:
        return np.asarray(friction)
    rest = springs - friction @ (friction.swapaxes(1, 2) @ springs)
    bases, sizes, _ = np.linalg.svd(rest, full_matrices=False)
    whole = np.linalg.norm(springs, axis=(1, 2))[:, None]
    # Share of the columns' size below which what is left of them is rounding.
    return np.concatenate([friction, bases * (sizes > 1e-9 * whole)[:, None, :]], axis=2)


def find_best_assignment(fit: TorqueFit) -> TorqueFit:
    """Swap pairs of joints as long as the torques fit decisively better, and one joint well."""
    best = fit
    for _ in range(fit.model.n_joints):
        change = choose_decisive_change(
            best, best.changes(), lambda each: each.cost, THRESHOLDS.fall
        )
        if change is None:
            break
        moved = [
            k
            for k in range(fit.model.n_joints)
            if (change.torque_of[k], change.motion_of[k]) != (best.torque_of[k], best.motion_of[k])
        ]
        if max(abs(change.correlation[moved])) < THRESHOLDS.correlation:
            break
        best = change
    return best


@dataclass(frozen=True, slots=True)
class SwapThresholds:
    """Decide from the sum over joints of the logarithm of the unexplained variance."""

    fall: float = 4.0
    """Fall of the sum from which a swap is decisive: both shares fall to an eighth."""
    floor: float = 1e-3
    """Unexplained share below which a better fit does not count."""
    each: float = 0.5
    """Largest unexplained share of each of the two torques, relative to that as logged: a torque
    that is constant, or noise alone, is explained no better at another joint."""
    rows_per_parameter: int = 3
    """Torques per parameter below which any order is explained."""
    singular: float = 1e-10
    """Relative eigenvalue of the scaled normal equations of a direction that is not excited."""


SWAP = SwapThresholds()


@dataclass(frozen=True, slots=True)
class TorqueSwap:
    """Hold two joints (from 0) whose torques are swapped, and their mean unexplained variance.

    Both shares are fractions of the torque's variance, in the order logged and after swapping.
    """

    joints: tuple[int, int]
    as_logged: float
    swapped: float


def find_swapped_torques(fit: TorqueFit) -> TorqueSwap | None:
    """Return the swap of two torques that base parameters and friction explain decisively better.

    Each order has its own least-squares fit of base parameters, viscous and Coulomb friction and
    offsets, torques scaled to unit variance. CAD values are not used, so the wrists of an arm,
    where friction exceeds the rigid-body torque, are checked too.
    """
    n, samples = fit.model.n_joints, len(fit.q)
    base = find_base_parameters(fit.model, DriveSet.parse("viscous,offset"))
    p = base.n_base + n
    if samples * n < SWAP.rows_per_parameter * p:
        return None
    pick, torque = list(fit.motion_of), fit.tau[:, list(fit.torque_of)]
    q, qd, qdd = (values[:, pick] for values in (fit.q, fit.qd, fit.qdd))
    W = np.zeros((samples, n, p))
    W[:, :, : base.n_base] = observation_matrix(
        fit.model, q, qd, qdd, drive=base.drive, columns=base.columns
    ).reshape(samples, n, -1)
    W[:, range(n), range(base.n_base, p)] = np.tanh(qd / BREAKAWAY)
    y = torque - torque.mean(axis=0)
    spread = y.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    y = y / spread
    normal = _NormalEquations(
        W.transpose(1, 2, 0) @ W.transpose(1, 0, 2),
        y.T @ W.transpose(1, 0, 2),
        np.mean(y**2, axis=0),
        spread,
        samples,
    )
    logged = tuple(range(n))
    found = choose_decisive_change(
        logged,
        list_swaps(logged),
        normal.cost,
        SWAP.fall,
    )
    if found is None:
        return None
    i, j = (k for k in range(n) if found[k] != k)
    before, after = (normal.unexplained(order)[[i, j]].mean() for order in (logged, found))
    return TorqueSwap((i, j), float(before), float(after))


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """The normal equations of each joint's rows with each joint's torque.

    `grams` (n, p, p), `sides` (n, n, p) for torques of unit variance, `power` and `spread` (n,) of
    the torques, scaled and as logged.
    """

    grams: Array
    sides: Array
    power: Array
    spread: Array
    samples: int

    def cost(self, torque_of: tuple[int, ...]) -> float:
        """Return the sum of logarithms of the unexplained shares, if each torque moved gains."""
        logged = self.unexplained(tuple(range(len(torque_of)))) + SWAP.floor
        shares = self.unexplained(torque_of) + SWAP.floor
        moved = [(k, j) for k, j in enumerate(torque_of) if k != j]
        if any(self.power[j] == 0.0 or shares[k] > SWAP.each * logged[j] for k, j in moved):
            return np.inf
        return float(np.sum(np.log(shares)))

    def unexplained(self, torque_of: tuple[int, ...]) -> Array:
        """Return the unexplained share (n,) of the torques if joint k has `torque_of[k]`."""
        order = list(torque_of)
        scale = 1.0 / self.spread[order]
        side = np.stack([self.sides[k, j] for k, j in enumerate(order)])
        gram = np.tensordot(scale**2, self.grams, axes=1)
        size = np.sqrt(np.diag(gram))
        size = np.where(size > 0.0, size, 1.0)
        eigenvalues, axes = np.linalg.eigh(gram / np.outer(size, size))
        excited = eigenvalues > SWAP.singular * eigenvalues[-1]
        axes = axes[:, excited] / size[:, None]
        beta = axes @ ((axes.T @ (scale @ side)) / eigenvalues[excited])
        explained = scale**2 * (self.grams @ beta @ beta)
        residual = self.power[order] + (explained - 2.0 * scale * (side @ beta)) / self.samples
        return np.asarray(np.maximum(residual, 0.0))
