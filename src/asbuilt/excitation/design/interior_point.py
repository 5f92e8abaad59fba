"""Primal-dual interior-point method whose iterates respect every constraint."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from asbuilt.arrays import Array
from asbuilt.excitation.state_constraint import StateConstraint

# Constants of the method; Nocedal & Wright (2006), chapter 19, unless noted.

SOLVER_TO_BOUNDARY = 0.995  # Largest fraction of the way to a constraint that one step takes
SOLVER_ARMIJO = 1e-4  # Least decrease of the barrier function relative to its slope
SOLVER_SHRINKAGE = 0.2  # Factor by which the barrier weight falls
SOLVER_STEPS = 40  # Most steps at one barrier weight
SOLVER_DAMPING = 0.2  # Least curvature along a step relative to that before (Powell 1978)
SOLVER_BACKTRACKS = 14  # Halvings of a step before BFGS starts afresh
SOLVER_SPREAD = 1e8  # Factor between multiplier times slack and the barrier weight


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A value, minus infinity where undefined, and its gradient by q, qd, qdd, each (N, n)."""

    value: float
    gradient: Callable[[], tuple[Array, Array, Array]]


class MotionProgram(ABC):
    """Maximise a function of the states `d^k q / dt^k (t_s) = bases[k] @ coefficients`.

    Coefficients are (n_basis, n), `bases[k]` (N, n_basis) for the orders 0 ... 3. Each derivative
    must stay within `centre[k] +- half[k]` (n,), half may be infinite, and the values of state
    constraints below `1 - margin`.
    """

    bases: tuple[Array, ...]
    centre: Array
    half: Array
    constraints: tuple[StateConstraint, ...]
    margin: float

    @abstractmethod
    def evaluate(self, q: Array, qd: Array, qdd: Array) -> Evaluation:
        """Return the function to be maximised."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the coefficients, (n_basis, n)."""
        return self.bases[0].shape[1], self.half.shape[1]

    def states(self, coefficients: Array) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations at the nodes."""
        return (
            self.bases[0] @ coefficients,
            self.bases[1] @ coefficients,
            self.bases[2] @ coefficients,
        )

    def margins(self, coefficients: Array) -> list[Array]:
        """Return the slacks (sides, N, m) of each order, then of each state constraint.

        The upper side comes first; a constraint that is not two-sided has no lower one.
        """
        slacks = []
        for basis, centre, half in zip(self.bases, self.centre, self.half, strict=True):
            v = (basis @ coefficients - centre) / half
            slacks.append(np.stack([1.0 - v, 1.0 + v]))
        state = self.states(coefficients)
        for constraint in self.constraints:
            v = constraint.values(*state)
            most = 1.0 - self.margin
            slacks.append(np.stack([most - v, most + v] if constraint.two_sided else [most - v]))
        return slacks

    def smallest_margin(self, coefficients: Array) -> float:
        """Return the smallest of all slacks; strictly feasible coefficients have a positive one."""
        return min(float(slack.min()) for slack in self.margins(coefficients))


@dataclass(frozen=True, eq=False)
class Optimum:
    """A local optimum of search `number`: coefficients (n_basis, n), value, iterations spent."""

    coefficients: Array
    value: float
    iterations: int = 0
    number: int = 0


@dataclass(eq=False)
class _Point:
    """Coefficients with value and gradient, slopes of the state constraints, and all slacks."""

    coefficients: Array
    value: float
    gradient: Array
    curved: list[Array]
    slacks: list[Array]


def solve(
    program: MotionProgram,
    start: Array,
    *,
    barrier: tuple[float, float] = (0.1, 1e-4),
    most_iterations: int = 400,
    cancelled: Callable[[], bool] = lambda: False,
) -> Optimum | None:
    """Climb from strictly feasible coefficients; return None if the start is not feasible.

    The barrier problem `max f + mu sum log s` is solved for falling mu by Newton steps with
    primal-dual multipliers for the constraints, whose curvature is exact to first order, and a
    damped BFGS approximation of the curvature of f (Nocedal & Wright 2006, chapter 19; Powell
    1978). Line search on the barrier function itself keeps all slacks positive.
    """
    x = np.array(start, dtype=np.float64)
    mu, mu_end = barrier
    slacks = program.margins(x)
    evaluation = program.evaluate(*program.states(x))
    # Only strictly inside has the barrier a value.
    if min(float(s.min()) for s in slacks) <= 0 or not np.isfinite(evaluation.value):
        return None
    point = _make_point(program, x, slacks, evaluation)
    metric = _build_metric(program)
    # Length of the gradient in the metric: tolerances are relative to it.
    scale = max(1.0, float(np.sqrt(point.gradient @ np.linalg.solve(metric, point.gradient))))
    curvature = scale * metric
    fresh = True
    # On the central path: multiplier times slack is mu.
    duals = [mu / s for s in point.slacks]
    since = 0
    spent = 0
    for spent in range(1, most_iterations + 1):  # noqa: B007
        if cancelled():
            break
        pull = [_subtract_lower(z) for z in duals]
        residual = -point.gradient + _sum_all_slopes(program, point, pull)
        mismatch = max(
            # How far multipliers are from the central path.
            float(np.abs(z * s - mu).max())
            for z, s in zip(duals, point.slacks, strict=True)
        )
        error = max(float(np.abs(residual).max()) / scale, mismatch)
        since += 1
        # Solved well enough for this barrier, or it does not get better: on to the next.
        if error < 10 * mu or since > SOLVER_STEPS:
            if mu <= mu_end * 1.0001:
                break
            mu = max(mu_end, SOLVER_SHRINKAGE * mu)
            since = 0
        # Gradient of the barrier function itself, by which the line search goes.
        steep = [_subtract_lower(mu / s) for s in point.slacks]
        slope = -point.gradient + _sum_all_slopes(program, point, steep)
        # Primal-dual: multipliers over slacks in place of mu over slack squared.
        stiffness = [(z / s).sum(axis=0) for z, s in zip(duals, point.slacks, strict=True)]
        hessian = curvature + _build_stiffness(program, point, stiffness)
        try:
            step = -cho_solve(cho_factor(hessian), slope)
        except np.linalg.LinAlgError:
            # Rounding has made the curvature indefinite: the metric is a fresh start.
            curvature = scale * metric
            fresh = True
            continue
        moved, length = _search_line(program, point, step, slope, mu)
        # No step helps: with a fresh curvature the barrier is at fault, else the curvature.
        if moved is None:
            if fresh:
                if mu <= mu_end * 1.0001:
                    break
                mu = max(mu_end, SOLVER_SHRINKAGE * mu)
                since = 0
            curvature = scale * metric
            fresh = True
            duals = [mu / s for s in point.slacks]
            continue
        shift = length * step
        duals = _step_duals(program, point, moved, duals, step, mu)
        # Only what is curved in the coefficients: box limits are linear.
        pull = [_subtract_lower(z) for z in duals]
        change = _evaluate_curved_gradient(program, moved, pull) - _evaluate_curved_gradient(
            program, point, pull
        )
        if fresh:
            # A first guess of the size of the curvature, from the first step.
            sharp = float(shift @ change)
            if sharp > 0:
                curvature = metric * max(1e-3 * scale, sharp / float(shift @ metric @ shift))
            fresh = False
        curvature = _update_curvature(curvature, shift, change)
        point = moved
    return Optimum(point.coefficients, point.value, spent)


def _flatten(by_coefficient: Array) -> Array:
    """Return (n_basis, n) joint by joint; `reshape(n, n_basis).T` undoes it."""
    return by_coefficient.T.reshape(-1)


def _build_metric(program: MotionProgram) -> Array:
    """Return the quadratic form of the mean squared normalised q, qd and qdd."""
    n_basis, n = program.shape
    whole = np.zeros((n * n_basis, n * n_basis))
    for basis, half in zip(program.bases[:3], program.half, strict=False):
        gram = basis.T @ basis / len(basis)
        for j in range(n):
            block = slice(j * n_basis, (j + 1) * n_basis)
            whole[block, block] += gram / (half[j] ** 2 if np.isfinite(half[j]) else 1.0)
    # Directions that move nothing stay solvable.
    whole[np.diag_indices_from(whole)] *= 1 + 1e-9
    return whole


def _make_point(
    program: MotionProgram, coefficients: Array, slacks: list[Array], evaluation: Evaluation
) -> _Point:
    state = program.states(coefficients)
    gradient = sum(
        # Joint by joint, as coefficients are flattened.
        basis.T @ g
        for basis, g in zip(program.bases[:3], evaluation.gradient(), strict=False)
    )
    curved = [constraint.slopes(*state) for constraint in program.constraints]
    return _Point(coefficients, evaluation.value, _flatten(np.asarray(gradient)), curved, slacks)


def _sum_slopes(program: MotionProgram, slopes: Array, weights: Array) -> Array:
    """Return `sum weights dv/dx` over the values v (N, m) of one constraint, joint by joint."""
    samples, m, n, orders = slopes.shape
    by_state = (weights[:, None, :] @ slopes.reshape(samples, m, -1)).reshape(samples, n, orders)
    return _flatten(np.asarray(sum(program.bases[k].T @ by_state[:, :, k] for k in range(orders))))


def _differentiate_along(program: MotionProgram, slopes: Array, direction: Array) -> Array:
    """Return dv/dx along a direction (n_basis, n), (N, m)."""
    samples, m, _, orders = slopes.shape
    motion = np.stack([program.bases[k] @ direction for k in range(orders)], axis=2)
    return np.asarray((slopes.reshape(samples, m, -1) @ motion.reshape(samples, -1, 1))[:, :, 0])


def _build_curved_stiffness(program: MotionProgram, slopes: Array, weights: Array) -> Array:
    """Return `sum weights dv/dx (dv/dx)^T`, by way of the states of each sample."""
    samples, m, n, orders = slopes.shape
    rows = slopes.reshape(samples, m, -1)
    # First in the space of states, which is small, then through the bases.
    by_state = (rows * weights[:, :, None]).transpose(0, 2, 1) @ rows
    bases = np.stack(program.bases[:orders], axis=1)
    n_basis = bases.shape[2]
    half = (by_state.reshape(samples, -1, orders) @ bases).reshape(samples, n, orders, -1)
    flat = bases.reshape(-1, n_basis).T
    return np.vstack([flat @ half[:, j].reshape(samples * orders, -1) for j in range(n)])


def _subtract_lower(sides: Array) -> Array:
    """Return the upper less the lower side (N, m): they push against each other."""
    return np.asarray(sides[0] - sides[1] if len(sides) == 2 else sides[0])


def _sum_all_slopes(program: MotionProgram, point: _Point, weights: list[Array]) -> Array:
    """Return `sum weights dv/dx` over all normalised values v."""
    total = np.zeros(program.shape)
    for basis, half, w in zip(program.bases, program.half, weights, strict=False):
        total += basis.T @ (w / half)
    flat = _flatten(total)
    for slopes, w in zip(point.curved, weights[len(program.bases) :], strict=True):
        flat = flat + _sum_slopes(program, slopes, w)
    return flat


def _build_stiffness(program: MotionProgram, point: _Point, stiffness: list[Array]) -> Array:
    n_basis, n = program.shape
    whole = np.zeros((n * n_basis, n * n_basis))
    for basis, half, w in zip(program.bases, program.half, stiffness, strict=False):
        # Joints without a limit add nothing.
        for j in np.flatnonzero(np.isfinite(half)):
            block = slice(j * n_basis, (j + 1) * n_basis)
            whole[block, block] += (basis.T * (w[:, j] / half[j] ** 2)) @ basis
    for slopes, w in zip(point.curved, stiffness[len(program.bases) :], strict=True):
        whole += _build_curved_stiffness(program, slopes, w)
    return whole


def _evaluate_barrier(slacks: list[Array]) -> float:
    return sum(float(np.log(side).sum()) for sides in slacks for side in sides)


def _approach_sides(speed: Array) -> Array:
    """Return the rates (2, N, m) of the upper and lower slack where values change by `speed`."""
    return np.stack([-speed, speed])


def _find_way_to_zero(values: Array, step: Array) -> float:
    """Return the part of a step that positive values can go and remain positive."""
    falling = step < 0
    return SOLVER_TO_BOUNDARY * float((-values[falling] / step[falling]).min(initial=np.inf))


def _search_line(
    program: MotionProgram, point: _Point, step: Array, slope: Array, mu: float
) -> tuple[_Point | None, float]:
    direction = step.reshape(program.shape[::-1]).T
    length = 1.0
    # As far as the linear constraints allow; curved ones are asked at each trial.
    for sides, basis, half in zip(point.slacks, program.bases, program.half, strict=False):
        length = min(length, _find_way_to_zero(sides, _approach_sides(basis @ direction / half)))
    reference = -point.value - mu * _evaluate_barrier(point.slacks)
    fall = float(slope @ step)
    for _ in range(SOLVER_BACKTRACKS):
        trial = point.coefficients + length * direction
        slacks = program.margins(trial)
        worst = min(float((s / old).min()) for s, old in zip(slacks, point.slacks, strict=True))
        # No slack falls by more than the step may take it.
        if worst > 1 - SOLVER_TO_BOUNDARY:
            evaluation = program.evaluate(*program.states(trial))
            if -evaluation.value - mu * _evaluate_barrier(
                slacks
                # Rounding of the value is no rise.
            ) <= reference + SOLVER_ARMIJO * length * fall + 1e-12 * abs(reference):
                return _make_point(program, trial, slacks, evaluation), length
        length *= 0.5
    return None, 0.0


def _step_duals(
    program: MotionProgram, old: _Point, new: _Point, duals: list[Array], step: Array, mu: float
) -> list[Array]:
    """Take the Newton step of the positive multipliers and keep them near the central path."""
    direction = step.reshape(program.shape[::-1]).T
    speeds = [
        basis @ direction / half for basis, half in zip(program.bases, program.half, strict=True)
    ]
    speeds += [_differentiate_along(program, slopes, direction) for slopes in old.curved]
    rates = [_approach_sides(speed)[: len(s)] for speed, s in zip(speeds, old.slacks, strict=True)]
    # s z = mu, linearised.
    moves = [mu / s - z - z / s * ds for z, s, ds in zip(duals, old.slacks, rates, strict=True)]
    length = 1.0
    for z, dz in zip(duals, moves, strict=True):
        length = min(length, _find_way_to_zero(z, dz))
    spread = SOLVER_SPREAD
    return [
        # Far from the path a multiplier would stiffen or slacken its constraint for good.
        np.clip(z + length * dz, mu / s / spread, mu / s * spread)
        for z, dz, s in zip(duals, moves, new.slacks, strict=True)
    ]


def _evaluate_curved_gradient(program: MotionProgram, point: _Point, pull: list[Array]) -> Array:
    """Return the part of the Lagrangian's gradient that is not linear in the coefficients."""
    total = -point.gradient
    for slopes, w in zip(point.curved, pull[len(program.bases) :], strict=True):
        total = total + _sum_slopes(program, slopes, w)
    return total


def _update_curvature(curvature: Array, shift: Array, change: Array) -> Array:
    """Update with Powell's damping, so that the matrix stays positive definite."""
    forward = curvature @ shift
    along = float(shift @ forward)
    sharp = float(shift @ change)
    if along <= 0:
        return curvature
    if sharp < SOLVER_DAMPING * along:
        # Powell: a mixture with the old curvature, so that the update stays positive.
        theta = (1 - SOLVER_DAMPING) * along / (along - sharp)
        change = theta * change + (1 - theta) * forward
        sharp = float(shift @ change)
    return np.asarray(
        curvature - np.outer(forward, forward) / along + np.outer(change, change) / sharp
    )
