"""Nonlinear parameters of drive terms - a Stribeck velocity, an exponent, the width of a sign - by variable
projection over everything linear.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.term import DriveTerm, NonlinearParameter
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure, Finding
from asbuilt.identification.errors.nonlinear_errors import NonlinearPlace
from asbuilt.identification.information.rows import SampleBlock, sample_blocks

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


MOST_SAMPLES = 20_000
"""Filtered samples that a fit of nonlinear parameters looks at; of longer recordings every so many time blocks."""
GRID = 24
"""Values tried over the whole range of a nonlinear parameter,"""
REFINEMENTS = 10
"""then so many golden sections about the best of each joint."""
TOLD = 30.0
"""A nonlinear parameter is told where it lowers the squared error of its joint by this fraction, divided by the
number of filtered samples (an F of 30 for white residuals, of a few for correlated ones), and where
the least error lies within the credible range; elsewhere it keeps its default.
"""
AT_BOUND = 0.02
"""A value this share of the range from one of its ends is said to sit there."""
SLOWEST_SHARE = 0.03
"""A speed is looked for above the slowest samples of a joint, this share of those that move."""
CYCLES = 10
"""Most rounds over the nonlinear parameters, where there are several,"""
SETTLED = 0.01
"""which end when no nonlinear parameter moves by more than this fraction."""
SAME_COLUMN = 1e-8
"""What is left of a column beside all others, relative to its size, below which it is one of their
sums.
"""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FittedNonlinear:
    """The values of a nonlinear parameter, one per joint, the fraction of the squared error that the term takes
    away there, and where the data told the value.

    `at_bound` says where the data would like a value at an end of the credible range, or beyond it,
    `lowest` to `highest` (n,): there the term is not what its name says.
    """

    term: str
    parameter: NonlinearParameter
    values: tuple[float, ...]
    reduction: Array
    told: NDArray[np.bool_]
    at_bound: NDArray[np.bool_]
    lowest: Array
    highest: Array


@dataclass(frozen=True, slots=True, eq=False)
class NonlinearFit:
    """The drive with every nonlinear parameter stated, and how each was found."""

    drive: DriveSet
    nonlinear: tuple[FittedNonlinear, ...]

    @property
    def places(self) -> tuple[NonlinearPlace, ...]:
        """The nonlinear parameters and joints where the data told a value."""
        present = {term.key: term for term in self.drive.terms}
        return tuple(
            NonlinearPlace(found.term, found.parameter.name, k)
            for found in self.nonlinear
            for k in np.flatnonzero(found.told).tolist()
            if present[found.term].is_at(k)
        )

    def sentences(self, joint_names: Sequence[str]) -> tuple[str, ...]:
        """Say what was found, a sentence per nonlinear parameter."""
        said = []
        for found in self.nonlinear:
            unit = f" {found.parameter.unit}" if found.parameter.unit else ""
            listed = ", ".join(
                f"{name} {value:.3g}{'' if told else ' (not told, default)'}"
                for name, value, told in zip(joint_names, found.values, found.told, strict=True)
            )
            said.append(
                f"{found.parameter.name} of {found.term}, fitted by variable projection: {listed}{unit}"
            )
        return tuple(said)

    def findings(self, joint_names: Sequence[str]) -> tuple[Finding, ...]:
        """Return a finding for each nonlinear parameter that lies at an end of its range."""
        said = []
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
                said.append(
                    Finding(
                        "nonlinear_parameters",
                        "warning",
                        f"The best {found.parameter.name} of {found.term} lies at an end of its"
                        f" credible range at {', '.join(bounded)}, so the friction there is of"
                        " another kind; the default is kept",
                        Cure("leave the term out at these joints, or state the value"),
                    )
                )
        return tuple(said)


def fit_nonlinear(model: RobotModel, drive: DriveSet, samples: Sequence[Samples]) -> NonlinearFit:
    """Fit the nonlinear parameters that are not stated, joint by joint, each to the least squared error that
    remains after all linear parameters of its joint.

    For joint k and nonlinear parameter s, `min_s |P(s) tau_k|^2` with P the projection off the columns of joint
    k, links free for each joint (a little freer than the robot is, so that no joint waits for
    another). The parameter of the term is held positive, friction that brakes, unless the simpler
    term that it stands for is beside it, of which it may take away. The credible range of the nonlinear parameter
    is searched whole, then refined, because the error has several minima. The load of
    load-dependent terms is that of `model`.

    Source: Golub and Pereyra, SIAM J. Numerical Analysis 10, 1973: variable projection. Raises
    `IdentifiabilityError` where filtering leaves no samples.
    """
    found: dict[tuple[str, str], FittedNonlinear] = {}
    current = drive
    free = [(term.key, parameter) for term in drive.terms for parameter in term.free_nonlinear]
    chosen = thinned(model, samples)
    if not chosen:
        raise IdentifiabilityError(
            f"no samples of {model.name} are left to fit the nonlinear parameters of {drive} to: every contiguous"
            " stretch is shorter than the filter needs; record longer, raise the cutoff, or state"
            " the nonlinear parameters"
        )
    with one_blas_thread():
        for _ in range(CYCLES if len(free) > 1 else 1):
            before = {place: np.array(each.values) for place, each in found.items()}
            for key, parameter in free:
                term = next(term for term in current.terms if term.key == key)
                fitted = _fit_one(model, current.without(key), term, parameter, chosen)
                found[key, parameter.name] = fitted
                current = current.with_term(term.with_nonlinear({parameter.name: fitted.values}))
            if all(
                place in before
                and np.all(np.abs(before[place] - each.values) <= SETTLED * np.abs(each.values))
                for place, each in found.items()
            ):
                break
    return NonlinearFit(current, tuple(found.values()))


def thinned(model: RobotModel, samples: Sequence[Samples]) -> list[SampleBlock]:
    """Return the time blocks of samples that fits of drive terms look at.

    All, or of long recordings every so many.
    """
    every = list(sample_blocks(model, samples))
    step = max(1, -(-sum(each.n_outputs for each in every) // MOST_SAMPLES))
    return every[::step]


def _fit_one(
    model: RobotModel,
    others: DriveSet,
    term: DriveTerm,
    parameter: NonlinearParameter,
    chosen: Sequence[SampleBlock],
) -> FittedNonlinear:
    n = model.n_joints
    remaining = _Remaining(model, others, chosen)
    braking = term.stands_for not in others.keys

    def error(values: Array) -> Array:
        return remaining.with_term(
            term.with_nonlinear({parameter.name: tuple(float(value) for value in values)}),
            positive=braking,
        )

    lowest, highest = credible_range(
        model, parameter, [np.abs(each.samples.qd[each.start : each.stop]) for each in chosen]
    )
    logarithmic = parameter.lower > 0.0
    first, last = (np.log(lowest), np.log(highest)) if logarithmic else (lowest, highest)

    def real(points: Array) -> Array:
        return np.clip(np.exp(points) if logarithmic else points, lowest, highest)

    grid = np.linspace(first, last, GRID)
    errors = np.array([error(real(points)) for points in grid])
    best = errors.argmin(axis=0)
    every = np.arange(n)
    low, high = grid[np.maximum(best - 1, 0), every], grid[np.minimum(best + 1, GRID - 1), every]
    a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_a, at_b = error(real(a)), error(real(b))
    for _ in range(REFINEMENTS):
        left = at_a < at_b
        low, high = np.where(left, low, a), np.where(left, b, high)
        renewed = np.where(left, high - GOLDEN * (high - low), low + GOLDEN * (high - low))
        at = error(real(renewed))
        a, b, at_a, at_b = (
            np.where(left, renewed, b),
            np.where(left, a, renewed),
            np.where(left, at, at_b),
            np.where(left, at_a, at),
        )
    values, least = real(np.where(at_a < at_b, a, b)), np.minimum(at_a, at_b)
    worse = least > errors.min(axis=0)
    values = np.where(worse, real(grid[best, every]), values)
    reduction = 1.0 - np.minimum(least, errors.min(axis=0)) / np.maximum(
        remaining.energy, np.finfo(np.float64).tiny
    )
    margin = AT_BOUND * (last - first)
    placed = np.log(values) if logarithmic else values
    lowers = reduction > TOLD / sum(each.n_outputs for each in chosen)
    at_bound = lowers & ((placed < first + margin) | (placed > last - margin))
    told = lowers & ~at_bound
    stated = tuple(float(f"{value:.4g}") for value in np.where(told, values, parameter.default))
    within = tuple(min(max(value, parameter.lower), parameter.upper) for value in stated)
    return FittedNonlinear(term.key, parameter, within, reduction, told, at_bound, lowest, highest)


def credible_range(
    model: RobotModel, parameter: NonlinearParameter, speeds: Sequence[Array]
) -> tuple[Array, Array]:
    """Return the range in which a nonlinear parameter of each joint is looked for, two (n,).

    That of its physics, and for a speed what the recording has.

    `speeds` are |qd| (N, n) of each stretch. The top speed of a joint is its limit, the highest of
    the recording where none is described. A speed below the slowest few samples cannot be told from
    none.
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
            np.quantile(v[v > 0.0], SLOWEST_SHARE) if np.any(v > 0.0) else parameter.lower
            for v in moved.T
        ]
    )
    lowest = np.clip(np.maximum(low * top, slowest), parameter.lower, parameter.upper)
    return lowest, np.clip(high * top, lowest, parameter.upper)


class _Remaining:
    """What the torque of each joint has left after all columns but one term's, ready to be asked
    what that term leaves of it.
    """

    def __init__(self, model: RobotModel, others: DriveSet, chosen: Sequence[SampleBlock]) -> None:
        self._model, self._chosen = model, chosen
        base = find_base_parameters(model, others)
        plan = RegressorPlan.of(model, others, base.columns, spare_rows=1)
        rows = _joined(plan, chosen)
        self._bases, self._torques = [], []
        for joint in rows:
            columns, torque = joint[:-1], joint[-1]
            sizes = np.linalg.norm(columns, axis=1)
            present = sizes > 1e-12 * sizes.max(initial=0.0)
            _, s, vt = np.linalg.svd(columns[present] / sizes[present, None], full_matrices=False)
            basis = vt[s > SAME_COLUMN * s.max(initial=0.0)]
            self._bases.append(basis)
            self._torques.append(torque - basis.T @ (basis @ torque))
        self.energy = np.array([float(torque @ torque) for torque in self._torques])

    def with_term(self, term: DriveTerm, *, positive: bool) -> Array:
        """Return the squared error of each joint that is left beside the columns of this term,
        shape (n,); with `positive` only if their parameters are.
        """
        n, per = self._model.n_joints, len(term.symbols)
        plan = RegressorPlan.of(
            self._model, DriveSet((term,)), np.arange(10 * n, (10 + per) * n), spare_rows=1
        )
        left = []
        for rows, basis, torque in zip(
            _joined(plan, self._chosen), self._bases, self._torques, strict=True
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


def _joined(plan: RegressorPlan, chosen: Sequence[SampleBlock]) -> list[Array]:
    chunks: Iterator[tuple[Array, ...]] = (
        tuple(rows.copy() for rows in chunk) for each in chosen for chunk in each.chunks(plan)
    )
    return [np.hstack(parts) for parts in zip(*chunks, strict=True)]
