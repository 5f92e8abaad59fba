"""Information of joint states about the base parameters, its derivatives, and criteria of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve

from asbuilt.arrays import Array, Indices, Mask, read_only
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, drive_columns, inverse_dynamics
from asbuilt.dynamics.drives.drive_set import NO_DRIVE
from asbuilt.dynamics.drives.term import STATE, Formula
from asbuilt.dynamics.kernels.regressor_adjoint import regressor_adjoint
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import UsageError
from asbuilt.excitation.limits import MotionBounds

SCALING_STATES = 500
"""Random states over which the units of the parameters are averaged."""


# Hold how drive columns that jump with the sign of the velocity are evaluated.

# Width, relative to the velocity limit, over which `tanh(qd / width)` smooths drive columns that
# jump with the sign of velocity while a motion is designed; reports use the exact columns
SMOOTHING_SIGN_WIDTH = 0.02
SMOOTHING_STEP = 1e-6  # Step of the central differences through drive columns
# Speed at which a column is evaluated just before and after standstill [rad/s or m/s]
SMOOTHING_SMALLEST_SPEED = 1e-12
SMOOTHING_LEAST_JUMP = 1e-3  # Change across standstill above which a drive column jumps there


@dataclass(frozen=True, eq=False, repr=False)
class Information:
    """Evaluate and differentiate `M = sum_s Y_s^T S^-1 Y_s` over samples s.

    Y are the base columns, S is the diagonal of `noise` squared; `noise` (n,) is the standard
    deviation of each joint torque [N m or N].
    """

    model: RobotModel
    base: BaseParameters
    noise: Array
    width: Array

    def __repr__(self) -> str:
        return f"Information({self.model.name!r}, {self.n_parameters} parameters)"

    @classmethod
    def of(cls, model: RobotModel, base: BaseParameters, noise: ArrayLike = 1.0) -> Information:
        """Prepare the evaluation; raises `UsageError` unless the noise is positive."""
        sigma = np.asarray(noise, dtype=np.float64)
        if (
            sigma.shape not in ((), (1,), (model.n_joints,))
            or not np.all(np.isfinite(sigma))
            or not np.all(sigma > 0)
        ):
            raise UsageError(
                f"the noise must be one positive number or one per joint ({model.n_joints}), got"
                f" {sigma.tolist()}"
            )
        shared = [term.key for term in base.drive.terms if term.of_motor]
        if shared:
            raise UsageError(
                f"drive term {shared[0]!r} belongs to motors that move several joints; a motion"
                " cannot be designed for it, leave it out"
            )
        velocity = MotionBounds.assumed(model).velocity
        return cls(
            model,
            base,
            read_only(np.broadcast_to(sigma, (model.n_joints,))),
            read_only(SMOOTHING_SIGN_WIDTH * velocity),
        )

    @cached_property
    def plan(self) -> RegressorPlan:
        """The evaluation of the base columns."""
        return RegressorPlan.of(self.model, self.base.drive, self.base.columns)

    @cached_property
    def joints(self) -> tuple[tuple[Indices, slice, float], ...]:
        """Base parameters, rows in the layout of `plan`, and noise of each joint."""
        rows = (slice(*bounds) for bounds in self.plan.bounds.tolist())
        return tuple(zip(self.plan.support, rows, self.noise.tolist(), strict=True))

    @property
    def n_parameters(self) -> int:
        """Number of base parameters, drive terms included."""
        return self.base.n_base

    def rows(self, q: Array, qd: Array, qdd: Array, *, smooth: bool = True) -> Array:
        """Return the base columns of all joints in the layout of `plan`, (n_rows, at least N).

        `smooth` replaces jumps of drive columns.
        """
        out = self.plan.buffer(len(q))
        if not smooth or not self.base.drive:
            self.plan.evaluate(q, qd, qdd, out)
            return out
        self._bodies.evaluate(q, qd, qdd, out)
        columns = self._evaluate_drive_columns(self._list_state(q, qd, qdd))
        for k, (chosen, places) in enumerate(self._drive_places):
            out[places, : len(q)] = columns[chosen, :, k]
        return out

    def matrix(self, rows: Array, n_samples: int) -> Array:
        """Return M (p, p) from what `rows` returned."""
        total = np.zeros((self.n_parameters, self.n_parameters))
        for support, own, sigma in self.joints:
            w = rows[own, :n_samples] / sigma
            total[np.ix_(support, support)] += w @ w.T
        return total

    def state_gradient(
        self,
        q: Array,
        qd: Array,
        qdd: Array,
        rows: Array,
        sensitivity: Array,
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of `tr(P M)`, P = `sensitivity` constant, symmetric, each (N, n).

        With `d phi = tr(P dM)` this is the gradient of phi.
        """
        count = len(q)
        weights = np.zeros_like(rows)
        for support, own, sigma in self.joints:
            weights[own, :count] = (2.0 / sigma**2) * (
                sensitivity[np.ix_(support, support)] @ rows[own, :count]
            )
        drive = self.base.drive
        loads = None  # weights of the joint torques on which drive columns depend
        slopes = (np.zeros_like(q), np.zeros_like(q), np.zeros_like(q))
        if drive:
            given = np.zeros((drive.columns_per_joint, count, self.model.n_joints))
            for k, (chosen, places) in enumerate(self._drive_places):
                given[chosen, :, k] = weights[places, :count]
            state = self._list_state(q, qd, qdd)
            for order in self._drive_arguments:
                up, down = (
                    [x + step if i == order else x for i, x in enumerate(state)]
                    for step in (SMOOTHING_STEP, -SMOOTHING_STEP)
                )
                slope = self._evaluate_drive_columns(up) - self._evaluate_drive_columns(down)
                through = np.einsum("csk,csk->sk", given, slope) / (2 * SMOOTHING_STEP)
                if order < 3:
                    slopes[order][...] += through
                else:
                    loads = through
        found = regressor_adjoint(self.plan, q, qd, qdd, weights, loads, self.model.parameters)
        return found[0] + slopes[0], found[1] + slopes[1], found[2] + slopes[2]

    @cached_property
    def _bodies(self) -> RegressorPlan:
        """The same layout without evaluating the drive columns."""
        return replace(self.plan, drive=NO_DRIVE)

    @cached_property
    def _drive_places(self) -> tuple[tuple[Indices, Indices], ...]:
        """The drive columns of each joint in use, and their rows in the layout of `plan`."""
        per = self.base.drive.columns_per_joint
        found = []
        for k, (support, rows, _) in enumerate(self.joints):
            own = self.plan.columns[support] - (10 * self.model.n_links + k * per)
            found.append((own[own >= 0], rows.start + np.flatnonzero(own >= 0)))
        return tuple(found)

    def _evaluate_drive_columns(self, state: Sequence[Array]) -> Array:
        """Return smoothed drive columns (columns per joint, N, n); `state`: q, qd, qdd, (load)."""
        columns = self._evaluate_exact_drive_columns(state)
        jumps = self._jumps
        if np.any(jumps):
            speed = np.abs(state[1]) + SMOOTHING_SMALLEST_SPEED
            ahead, behind = (
                self._evaluate_exact_drive_columns([state[0], v, *state[2:]])[jumps]
                for v in (speed, -speed)
            )
            sign = np.tanh(state[1] / self.width)
            columns[jumps] = 0.5 * ((1 + sign) * ahead + (1 - sign) * behind)
        return columns

    def _evaluate_exact_drive_columns(self, state: Sequence[Array]) -> Array:
        drive = self.base.drive
        load = state[3] if drive.needs_load else None
        if not any(term.differs_by_joint for term in drive.terms):
            return drive.evaluate(*state[:3], load=load)
        joints = range(self.model.n_joints)
        return np.stack([drive_columns(drive, k, *state[:3], load=load) for k in joints], axis=2)

    def _list_state(self, q: Array, qd: Array, qdd: Array) -> list[Array]:
        load = [inverse_dynamics(self.model, q, qd, qdd)] if self.base.drive.needs_load else []
        return [q, qd, qdd, *load]

    @cached_property
    def _jumps(self) -> Mask:
        """Which drive columns jump at zero velocity."""
        n = self.model.n_joints
        still = np.tile(np.linspace(-1.0, 1.0, 7)[:, None], (1, n))
        ahead, behind = (
            self._evaluate_exact_drive_columns(
                [still, np.full((7, n), v), *[still] * (1 + self.base.drive.needs_load)]
            )
            for v in (1e-9, -1e-9)
        )
        return np.asarray(np.any(np.abs(ahead - behind) > SMOOTHING_LEAST_JUMP, axis=(1, 2)))

    @cached_property
    def _drive_arguments(self) -> tuple[int, ...]:
        """Which of q, qd, qdd and load the drive columns depend on."""
        columns = [column for term in self.base.drive.terms for column in term.columns]
        used = {name for column in columns for name in Formula(column).names}
        return tuple(order for order, name in enumerate(STATE) if name in used)


AT_ONCE = 2048
"""States evaluated together, for memory."""


def mean_information(information: Information, q: Array, qd: Array, qdd: Array) -> Array:
    """Return the information per sample of many states, with exact drive columns, (p, p)."""
    total = np.zeros((information.n_parameters, information.n_parameters))
    for start in range(0, len(q), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        total += information.matrix(
            information.rows(q[part], qd[part], qdd[part], smooth=False), len(q[part])
        )
    return total / len(q)


def draw_states(
    bounds: MotionBounds, count: int, rng: np.random.Generator, *, extreme: float = 0.0
) -> tuple[Array, Array, Array]:
    """Return states (count, n), uniform within the bounds.

    Velocities and accelerations sit at a limit or at zero with probability `extreme`.
    """
    n = bounds.lower.size
    found = [rng.uniform(bounds.lower, bounds.upper, size=(count, n))]
    for limit in (bounds.velocity, bounds.acceleration):
        inner = rng.uniform(-1, 1, size=(count, n))
        corner = rng.integers(-1, 2, size=(count, n)).astype(np.float64)
        found.append(limit * np.where(rng.uniform(size=(count, n)) < extreme, corner, inner))
    return found[0], found[1], found[2]


def parameter_scale(information: Information, bounds: MotionBounds) -> Array:
    """Return the change of each base parameter (p,) that changes the torque by its noise.

    The change of torque is an RMS over the state bounds.
    """
    states = draw_states(bounds, SCALING_STATES, np.random.default_rng(0))
    rows = information.rows(*states, smooth=False)
    size = np.diag(information.matrix(rows, SCALING_STATES)) / SCALING_STATES
    return np.asarray(1.0 / np.sqrt(np.maximum(size, 1e-12 * size.max())))


SMOOTHNESS = 16
"""Exponent of the norm that approximates the extreme eigenvalue in e and condition."""


class Criterion(ABC):
    """Rate an information matrix M (p, p) of scaled parameters; larger is better."""

    key: ClassVar[str]

    @abstractmethod
    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and its derivative with respect to M, symmetric (p, p).

        Minus infinity where M is not positive definite.
        """

    def value(self, information: Array) -> float:
        """Return the value alone."""
        return self.value_and_gradient(information)[0]


@dataclass(frozen=True)
class DOptimality(Criterion):
    """Maximise `log det M`: the smallest confidence ellipsoid, whatever the units."""

    key = "d"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return `log det M` and `M^-1`."""
        factor = _try_cholesky(information)
        if factor is None:
            return -np.inf, np.zeros_like(information)
        return 2.0 * float(np.log(np.diag(factor)).sum()), _invert_factored(factor)


@dataclass(frozen=True, eq=False)
class AOptimality(Criterion):
    """Maximise `-p log(tr(A M^-1) / p)`: the smallest mean variance of what A weighs.

    Without `weight` A is the identity, and the scaled parameters matter alike. With A (p, p) the
    mean of `Y^T Y` over the states of a motion it is the variance of the torque predicted there.

    Source: Atkinson, Donev & Tobias (2007), sections 10.2 and 10.6 (A-, V-optimality).
    """

    weight: Array | None = None
    key = "a"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and `p M^-1 A M^-1 / tr(A M^-1)`."""
        factor = _try_cholesky(information)
        if factor is None:
            return -np.inf, np.zeros_like(information)
        inverse = _invert_factored(factor)
        p = len(information)
        weighted = inverse if self.weight is None else self.weight @ inverse
        trace = float(np.trace(weighted))
        return -p * np.log(trace / p), p * (inverse @ weighted) / trace


@dataclass(frozen=True)
class EOptimality(Criterion):
    """Maximise p times the log of a smooth smallest eigenvalue, `(sum_i l_i^-s)^(-1/s)`, s = 16.

    No direction is left poorly determined.
    """

    key = "e"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and its gradient, from the eigenvalues of M."""
        eigenvalues, vectors = np.linalg.eigh(information)
        if eigenvalues[0] <= 0:
            return -np.inf, np.zeros_like(information)
        value, slope = _smooth_log_smallest(eigenvalues)
        p = len(information)
        return p * value, p * (vectors * slope) @ vectors.T


@dataclass(frozen=True)
class ConditionNumber(Criterion):
    """Minimise the condition number of the observation matrix.

    Maximise `-p/2 log` of a smooth `l_max / l_min` of M.
    """

    key = "condition"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and its gradient, from the eigenvalues of M."""
        eigenvalues, vectors = np.linalg.eigh(information)
        if eigenvalues[0] <= 0:
            return -np.inf, np.zeros_like(information)
        low, low_slope = _smooth_log_smallest(eigenvalues)
        high, high_slope = _smooth_log_smallest(1.0 / eigenvalues)
        slope = low_slope - high_slope / eigenvalues**2
        p = len(information)
        return p / 2 * (low + high), p / 2 * (vectors * slope) @ vectors.T


@dataclass(frozen=True)
class FocusedDOptimality(Criterion):
    """Maximise `log det` of the information on chosen parameters, all others being unknown too.

    `log det M - log det M_rest` (D_s).

    `chosen` are positions among the base parameters. Source: Atkinson, Donev & Tobias (2007),
    section 10.3.
    """

    chosen: tuple[int, ...]
    key = "d"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and `M^-1` less the inverse of the block of the others."""
        rest = np.setdiff1d(np.arange(len(information)), self.chosen)
        value, gradient = DOptimality().value_and_gradient(information)
        if not np.isfinite(value) or not rest.size:
            return value, gradient
        others, inverse = DOptimality().value_and_gradient(information[np.ix_(rest, rest)])
        gradient = gradient.copy()
        gradient[np.ix_(rest, rest)] -= inverse
        return value - others, gradient


CRITERIA: dict[str, type[Criterion]] = {
    kind.key: kind for kind in (DOptimality, AOptimality, EOptimality, ConditionNumber)
}
"""The criteria by key; `FocusedDOptimality` is d with a focus."""


def select_criterion(key: str, focus: ArrayLike | None = None) -> Criterion:
    """Return the criterion of this name, d with a focus as D_s.

    Raises UsageError for unknown names and for a focus with another criterion.
    """
    if key not in CRITERIA:
        raise UsageError(f"unknown criterion {key!r}; available: {', '.join(CRITERIA)}")
    if focus is None:
        return CRITERIA[key]()
    if key != "d":
        raise UsageError(f"a focus goes with the criterion d (it becomes D_s), not with {key!r}")
    return FocusedDOptimality(tuple(int(position) for position in np.asarray(focus)))


def _try_cholesky(matrix: Array) -> Array | None:
    try:
        factor = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return factor if np.all(np.isfinite(factor)) else None


def _invert_factored(factor: Array) -> Array:
    return np.asarray(cho_solve((factor, True), np.eye(len(factor))))


def _smooth_log_smallest(values: Array) -> tuple[float, Array]:
    smallest = values.min()
    powers = (smallest / values) ** SMOOTHNESS
    total = powers.sum()
    return float(np.log(smallest) - np.log(total) / SMOOTHNESS), powers / total / values
