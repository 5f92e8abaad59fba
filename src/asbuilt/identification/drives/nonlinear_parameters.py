"""Nonlinear parameters of drive terms, such as a Stribeck velocity: their values and errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import (
    BaseParameters,
    DriveSet,
    DriveTerm,
    NonlinearParameter,
    drive_torque,
    find_base_parameters,
    inverse_dynamics,
)
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import SampleBlock, divide_into_blocks
from asbuilt.identification.result.torque_prediction import expand_parameters
from asbuilt.identification.uncertainty.uncertainty import FEWEST_BLOCKS
from asbuilt.scaled import Scaled
from asbuilt.tables import round_with_error

# Hold how nonlinear parameters are searched, and when they are determined.

# Filtered samples of a fit; evenly spread time blocks of longer recordings
SEARCH_MOST_SAMPLES = 20_000
SEARCH_GRID = 24  # Values of the first search over the range of a nonlinear parameter
SEARCH_REFINEMENTS = 10  # Golden sections around the best value of each joint
# Least decrease of a joint's squared error, times the number of samples, for a determined value. An
# F of 30 for white residuals, of a few for correlated ones.
SEARCH_LEAST_F = 30.0
# Distance from an end of the range, as a fraction of the range, that counts as at the end
SEARCH_AT_BOUND = 0.02
# Share of slow moving samples of a joint below which no speed parameter is estimated
SEARCH_SLOWEST_SHARE = 0.03
SEARCH_CYCLES = 10  # Largest number of cycles over several nonlinear parameters
SEARCH_SETTLED = 0.01  # Largest relative change of any nonlinear parameter in the last cycle
SEARCH_SAME_COLUMN = 1e-8  # Relative singular value below which a column is a combination of others


GOLDEN = 0.5 * (5.0**0.5 - 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FittedNonlinear:
    """Hold the values of a nonlinear parameter, one per joint.

    `determined` says whether the data determine the value, `at_bound` whether the best value is at
    an end of the credible range `lowest` to `highest` (n,).
    """

    term: str
    parameter: NonlinearParameter
    values: tuple[float, ...]
    determined: NDArray[np.bool_]
    at_bound: NDArray[np.bool_]
    lowest: Array
    highest: Array


@dataclass(frozen=True, slots=True, eq=False)
class NonlinearFit:
    """Hold a drive with values of all nonlinear parameters, and how each was fitted."""

    drive: DriveSet
    nonlinear: tuple[FittedNonlinear, ...]

    @property
    def places(self) -> tuple[NonlinearPlace, ...]:
        """The determined nonlinear parameters, joint by joint."""
        present = {term.key: term for term in self.drive.terms}
        return tuple(
            NonlinearPlace(found.term, found.parameter.name, k)
            for found in self.nonlinear
            for k in np.flatnonzero(found.determined).tolist()
            if present[found.term].is_at(k)
        )

    def sentences(self, joint_names: Sequence[str]) -> tuple[str, ...]:
        """Return a note per nonlinear parameter."""
        notes = []
        for found in self.nonlinear:
            unit = f" {found.parameter.unit}" if found.parameter.unit else ""
            listed = ", ".join(
                f"{name} {value:.3g}{'' if determined else ' (undetermined, default)'}"
                for name, value, determined in zip(
                    joint_names, found.values, found.determined, strict=True
                )
            )
            notes.append(
                f"{found.parameter.name} of {found.term}, fitted by variable projection:"
                f" {listed}{unit}"
            )
        return tuple(notes)

    def findings(self, joint_names: Sequence[str]) -> tuple[Finding, ...]:
        """Return a finding for each nonlinear parameter that lies at an end of its range."""
        at_bounds = []
        for found in self.nonlinear:
            unit = f" {found.parameter.unit}" if found.parameter.unit else ""
            bounded = [
                f"{name} ({low:.3g} to {high:.3g}{unit})"
                for name, low, high, there in zip(
                    joint_names, found.lowest, found.highest, found.at_bound, strict=True
                )
                if there
            ]
            if bounded:
                at_bounds.append(
                    Finding(
                        "nonlinear_parameters",
                        "warning",
                        f"The best {found.parameter.name} of {found.term} lies at an end of its"
                        f" credible range at {', '.join(bounded)}, so the friction there is of"
                        " another kind; the default is kept",
                        Cure("leave the term out at these joints, or state the value"),
                    )
                )
        return tuple(at_bounds)


def fit_nonlinear(model: RobotModel, drive: DriveSet, samples: Sequence[Samples]) -> NonlinearFit:
    """Fit the free nonlinear parameters of a drive joint by joint.

    For joint k and nonlinear parameter s, `min_s |P(s) tau_k|^2` with P the projection off the
    linear columns of joint k, links independent for each joint. The linear parameter of the term is
    non-negative (dissipative), unless the simpler term that it replaces is present. The credible
    range is first searched on a grid, since the error has several minima. Load-dependent terms
    take their load from `model`.

    Source: Golub and Pereyra, SIAM J. Numerical Analysis 10, 1973 (variable projection). Raises
    `IdentifiabilityError` if filtering leaves no samples.
    """
    found: dict[tuple[str, str], FittedNonlinear] = {}
    current = drive
    free = [(term.key, parameter) for term in drive.terms for parameter in term.free_nonlinear]
    chosen = thin_blocks(model, samples)
    if not chosen:
        raise IdentifiabilityError(
            f"no samples of {model.name} are left to fit the nonlinear parameters of {drive}: every"
            " contiguous segment is shorter than the filter needs",
            cure=Cure("record longer, raise the cutoff, or state the nonlinear parameters"),
        )
    with use_one_blas_thread():
        for _ in range(SEARCH_CYCLES if len(free) > 1 else 1):
            before = {place: np.array(each.values) for place, each in found.items()}
            for key, parameter in free:
                term = next(term for term in current.terms if term.key == key)
                fitted = _fit_one(model, current.without(key), term, parameter, chosen)
                found[key, parameter.name] = fitted
                current = current.with_term(term.with_nonlinear({parameter.name: fitted.values}))
            if all(
                place in before
                and np.all(
                    np.abs(before[place] - each.values) <= SEARCH_SETTLED * np.abs(each.values)
                )
                for place, each in found.items()
            ):
                break
    return NonlinearFit(current, tuple(found.values()))


def thin_blocks(model: RobotModel, samples: Sequence[Samples]) -> list[SampleBlock]:
    """Return the time blocks for fits of drive terms, evenly spread if there are many."""
    segments = list(divide_into_blocks(model, samples, np.inf))
    step = -(-sum(segment.n_outputs for segment in segments) // SEARCH_MOST_SAMPLES)
    # Of few samples all are used, in as few calls as they have gaps.
    return segments if step <= 1 else list(divide_into_blocks(model, samples))[::step]


def _fit_one(
    model: RobotModel,
    others: DriveSet,
    term: DriveTerm,
    parameter: NonlinearParameter,
    chosen: Sequence[SampleBlock],
) -> FittedNonlinear:
    remaining = _Remaining(model, others, chosen)

    def error(values: Array) -> Array:
        return remaining.measure_error(
            term.with_nonlinear({parameter.name: tuple(values.tolist())}),
            positive=term.stands_for not in others.keys,
        )

    lowest, highest = credible_range(
        model,
        parameter,
        [
            np.abs(sample_block.samples.qd[sample_block.start : sample_block.stop])
            for sample_block in chosen
        ],
    )
    logarithmic = parameter.lower > 0.0
    first, last = (np.log(lowest), np.log(highest)) if logarithmic else (lowest, highest)

    def real(points: Array) -> Array:
        return np.clip(np.exp(points) if logarithmic else points, lowest, highest)

    grid = np.linspace(first, last, SEARCH_GRID)
    errors = np.array([error(real(points)) for points in grid])
    best = errors.argmin(axis=0)
    every = np.arange(model.n_joints)
    low, high = (grid[np.clip(best + side, 0, SEARCH_GRID - 1), every] for side in (-1, 1))
    a = high - GOLDEN * (high - low)
    b = low + GOLDEN * (high - low)
    at_a = error(real(a))
    at_b = error(real(b))
    for _ in range(SEARCH_REFINEMENTS):
        left = at_a < at_b
        low = np.where(left, low, a)
        high = np.where(left, b, high)
        renewed = np.where(left, high - GOLDEN * (high - low), low + GOLDEN * (high - low))
        at = error(real(renewed))
        # The point that stays is an inner one of the smaller span.
        kept = np.where(left, a, b)
        at_kept = np.where(left, at_a, at_b)
        a = np.where(left, renewed, kept)
        b = np.where(left, kept, renewed)
        at_a = np.where(left, at, at_kept)
        at_b = np.where(left, at_kept, at)
    values = real(np.where(at_a < at_b, a, b))
    least = np.minimum(at_a, at_b)
    of_grid = errors.min(axis=0)
    values = np.where(least > of_grid, real(grid[best, every]), values)
    energy = np.maximum(remaining.energy, np.finfo(np.float64).tiny)
    reduction = 1.0 - np.minimum(least, of_grid) / energy
    margin = SEARCH_AT_BOUND * (last - first)
    placed = np.log(values) if logarithmic else values
    lowers = reduction > SEARCH_LEAST_F / sum(sample_block.n_outputs for sample_block in chosen)
    at_bound = lowers & ((placed < first + margin) | (placed > last - margin))
    determined = lowers & ~at_bound
    within = tuple(
        min(max(float(f"{value:.4g}"), parameter.lower), parameter.upper)
        for value in np.where(determined, values, parameter.default)
    )
    return FittedNonlinear(term.key, parameter, within, determined, at_bound, lowest, highest)


def credible_range(
    model: RobotModel, parameter: NonlinearParameter, speeds: Sequence[Array]
) -> tuple[Array, Array]:
    """Return the credible range of a nonlinear parameter, two arrays (n,).

    Physics bounds the range, and the recording bounds a speed: `speeds` are |qd| (N, n) of each
    block. The top speed of a joint is its limit, or the highest of the recording. A speed below the
    slowest few samples is undetermined.
    """
    n = model.n_joints
    low, high = parameter.credible
    if not parameter.speed:
        return np.full(n, max(low, parameter.lower)), np.full(n, min(high, parameter.upper))
    moved = np.concatenate(speeds)
    limit = np.array([joint.limits.velocity for joint in model.joints])
    top = np.where(np.isfinite(limit) & (limit > 0), limit, moved.max(axis=0))
    slowest = np.array(
        [
            np.quantile(v[v > 0.0], SEARCH_SLOWEST_SHARE) if np.any(v > 0.0) else parameter.lower
            for v in moved.T
        ]
    )
    lowest = np.clip(np.maximum(low * top, slowest), parameter.lower, parameter.upper)
    return lowest, np.clip(high * top, lowest, parameter.upper)


class _Remaining:
    """Hold each joint's torque projected off the columns of all terms but one."""

    def __init__(self, model: RobotModel, others: DriveSet, chosen: Sequence[SampleBlock]) -> None:
        self._model = model
        self._chosen = chosen
        base = find_base_parameters(model, others)
        plan = RegressorPlan.of(model, others, base.columns, spare_rows=1)
        self._bases = []
        self._torques = []
        for rows in _stack_rows(plan, chosen):
            columns = rows[:-1]
            torque = rows[-1]
            sizes = np.linalg.norm(columns, axis=1)
            present = sizes > 1e-12 * sizes.max(initial=0.0)
            _, s, vt = np.linalg.svd(columns[present] / sizes[present, None], full_matrices=False)
            basis = vt[s > SEARCH_SAME_COLUMN * s.max(initial=0.0)]
            self._bases.append(basis)
            self._torques.append(torque - basis.T @ (basis @ torque))
        self.energy = np.array([float(torque @ torque) for torque in self._torques])

    def measure_error(self, term: DriveTerm, *, positive: bool) -> Array:
        """Return the squared error (n,) with this term; without it if not `positive` as asked."""
        own = 10 * self._model.n_links + np.arange(len(term.symbols) * self._model.n_joints)
        plan = RegressorPlan.of(self._model, DriveSet((term,)), own, spare_rows=1)
        left = []
        for rows, basis, torque in zip(
            _stack_rows(plan, self._chosen), self._bases, self._torques, strict=True
        ):
            columns = rows[:-1]
            rest = columns - (columns @ basis.T) @ basis
            rest = rest - (rest @ basis.T) @ basis
            kept = np.linalg.norm(rest, axis=1) > 1e-4 * np.linalg.norm(columns, axis=1)
            coefficients, *_ = np.linalg.lstsq(rest[kept].T, torque, rcond=None)
            if positive and np.any(coefficients < 0.0):
                coefficients = np.zeros_like(coefficients)
            error = torque - coefficients @ rest[kept]
            left.append(float(error @ error))
        return np.array(left)


def _stack_rows(plan: RegressorPlan, chosen: Sequence[SampleBlock]) -> list[Array]:
    return [np.hstack(parts) for parts in zip(*(block.rows(plan) for block in chosen), strict=True)]


STEP = 1e-3
"""Relative step of a nonlinear parameter for the derivative of the torque."""


@dataclass(frozen=True, slots=True)
class NonlinearPlace:
    """A nonlinear parameter at a joint (counted from 0), such as the velocity of stribeck."""

    term: str
    parameter: str
    joint: int

    def is_of(self, drive: DriveSet) -> bool:
        """Return whether a set has the term at the joint."""
        return any(term.key == self.term and term.is_at(self.joint) for term in drive.terms)


@dataclass(frozen=True, slots=True, eq=False)
class NonlinearErrors:
    """Hold values and standard errors (m,) of fitted nonlinear parameters, NaN if undetermined.

    `covariance` (p, p) is what they add to the covariance of the linear parameters.
    """

    places: tuple[NonlinearPlace, ...]
    values: Array
    std_errors: Array
    covariance: Array

    def sentence(self, joint_names: Sequence[str]) -> str:
        """Return a note with value and standard error of each nonlinear parameter."""
        parts: dict[str, list[str]] = {}
        for place, value, error in zip(self.places, self.values, self.std_errors, strict=True):
            shown = (
                " +- ".join(round_with_error(value, error))
                if np.isfinite(error)
                else f"{value:.3g} (undetermined)"
            )
            parts.setdefault(f"{place.parameter} of {place.term}", []).append(
                f"{joint_names[place.joint]} {shown}"
            )
        listed = "; ".join(f"{what} {', '.join(values)}" for what, values in parts.items())
        return f"Standard errors include errors of the fitted nonlinear parameters: {listed}."


@use_one_blas_thread()
def estimate_nonlinear_errors(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    samples: Sequence[Samples],
    places: Sequence[NonlinearPlace],
    *,
    textbook: bool = False,
    block_seconds: float | None = None,
) -> NonlinearErrors:
    """Return the errors of nonlinear parameters fitted with an estimate, to first order.

    With `C` the change of the weighted torque per parameter, `W` the weighted columns and `C' = C -
    W (W^T W)^-1 W^T C`, their covariance is `V = (C'^T C')^-1`, each error at least that from time
    blocks (`sum_b (C'^T e)_b^2`) unless `textbook`. The estimate follows by `G = -(W^T W)^-1 W^T
    C`, so its covariance grows by `G V G^T`, as in the fit with columns `[W C]` (Frisch and
    Waugh, Econometrica 1, 1933). Load-dependent terms have the load of `model`.
    """
    names = [(place.term, place.parameter) for place in places]
    nonlinear = list(dict.fromkeys(names))
    changes = _derive_changes(model, base, estimate.beta, nonlinear)
    first = [nonlinear.index(name) for name in names]
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=1 + len(nonlinear))
    root = estimate.solution.inverse_root
    m = len(places)
    r = root.shape[1]
    at = [[i for i, place in enumerate(places) if place.joint == k] for k in range(model.n_joints)]
    blocks = []
    for part in divide_into_blocks(model, samples, block_seconds):
        gram = np.zeros((r + m + 1, r + m + 1))
        for chunk in part.chunks(plan, partial(changes, part.samples)):
            for k, rows in enumerate(chunk):
                p_k = len(plan.support[k])
                error = rows[-1] - estimate.beta[plan.support[k]] @ rows[:p_k]
                seen = np.vstack(
                    [
                        root[plan.support[k]].T @ rows[:p_k],
                        # Only the parameters of this joint have a column here.
                        *(rows[None, p_k + first[i]] for i in at[k]),
                        error,
                    ]
                )
                where = np.ix_(*[[*range(r), *(r + i for i in at[k]), r + m]] * 2)
                gram[where] += estimate.weights[k] ** 2 * (seen @ seen.T)
        blocks.append(gram)
    together = np.sum(blocks, axis=0)
    known = together[:r, :r]
    across = together[:r, r : r + m]
    alone = together[r : r + m, r : r + m]
    moved = Scaled(known).solve(across)
    left = alone - moved.T @ across
    # Squared part of that derivative outside all linear columns below which it is undetermined.
    determined = np.flatnonzero(np.diag(left) > 1e-9 * np.diag(alone)).tolist()
    terms = {term.key: term for term in base.drive.terms}
    values = np.array([terms[p.term].at(p.joint).value(p.parameter) for p in places])
    errors = np.full(m, np.nan)
    if not determined:
        return NonlinearErrors(tuple(places), values, errors, np.zeros((base.n_base, base.n_base)))
    inverse = np.linalg.inv(left[np.ix_(determined, determined)])
    # Residual variance of the joint in the weighted rows: 1 where weights are 1 / sigma.
    noise = np.array(
        [estimate.sigma[places[i].joint] * estimate.weights[places[i].joint] for i in determined]
    )
    V = inverse * np.outer(noise, noise)
    if not textbook and len(blocks) >= FEWEST_BLOCKS:
        # Scores about the columns projected off the linear ones, as the residual is orthogonal to
        # both.
        own_rows = [r + i for i in determined]
        scores = np.array(
            [gram[own_rows, -1] - moved[:, determined].T @ gram[:r, -1] for gram in blocks]
        )
        clustered = np.sum((scores @ inverse) ** 2, axis=0) * len(blocks) / (len(blocks) - 1)
        swell = np.sqrt(np.maximum(clustered / np.diag(V), 1.0))
        V = V * np.outer(swell, swell)
    errors[determined] = np.sqrt(np.diag(V))
    follows = root @ moved[:, determined]
    return NonlinearErrors(tuple(places), values, errors, np.asarray(follows @ V @ follows.T))


def _derive_changes(
    model: RobotModel, base: BaseParameters, beta: Array, nonlinear: Sequence[tuple[str, str]]
) -> Callable[[Samples, slice], list[Array]]:
    """Return a function that gives the derivatives of every joint's torque on a span of samples.

    They are by each nonlinear parameter, (L, n) each.
    """
    n = model.n_joints
    values = expand_parameters(base, beta)[10 * base.n_links :].reshape(n, -1)
    of_terms = np.split(values, np.cumsum([len(term.symbols) for term in base.drive.terms]), axis=1)
    terms = {term.key: term for term in base.drive.terms}
    linear = dict(zip(terms, of_terms, strict=False))
    moved = []
    for key, name in nonlinear:
        term = terms[key]
        at = np.array([term.at(k).value(name) for k in range(n)])
        # Relative steps, as a velocity or a width has no other scale.
        sides = [
            DriveSet((term.with_nonlinear({name: tuple((at * (1.0 + step)).tolist())}),))
            for step in (STEP, -STEP)
        ]
        moved.append((sides, linear[key].ravel(), 2.0 * STEP * at))

    def changes(samples: Samples, span: slice) -> list[Array]:
        state = samples.q[span], samples.qd[span], samples.qdd[span]
        load = inverse_dynamics(model, *state) if base.drive.needs_load else None
        return [
            (
                drive_torque(ahead, theta, *state, load=load)
                - drive_torque(behind, theta, *state, load=load)
            )
            / step
            for (ahead, behind), theta, step in moved
        ]

    return changes
