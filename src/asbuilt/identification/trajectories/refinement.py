"""Refinement of parameters by trajectories: Levenberg and Marquardt over simulated windows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.identification.trajectories.objective import Objective, Point, Quadratic, Weights
from asbuilt.identification.trajectories.sensitivity import Motion
from asbuilt.identification.uncertainty.uncertainty import FEWEST_RECORDINGS
from asbuilt.scaled import Scaled


@dataclass(frozen=True, slots=True)
class Steps:
    """Say how the search goes: own choices, tested on real and virtual robots.

    At most `rounds` of weights follow one another, until they are the `same` but for that factor
    (logarithm), each with at most `most` steps; a round ends when the quadratic model promises to
    lower the cost by less than `roughly`, the last round by less than `settled`, in units of the
    logarithmic likelihood, and by less than that for each number of the starts of windows, or if a
    step lowered it by less. `damping` is the first relative damping; it falls fast, since little of
    it holds directions that only CAD determines.
    Windows whose error is beyond `outlying` times the `usual` quantile count no more than if it
    were that (a bounded influence, for moments that the model lacks).
    """

    rounds: int = 6
    same: float = 0.2
    most: int = 12
    roughly: float = 1.0
    settled: float = 0.01
    damping: float = 1e-3
    strongest: float = 1e6
    outlying: float = 3.0
    usual: float = 0.75


STEPS = Steps()
KEPT = (0.7, 1.0)
"""Parts of their old start that windows keep which spoil a step, tried in turn."""
FEW = 0.25
"""Largest share of windows that count as few."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Hold the refined point, its quadratic model, and how many steps it took."""

    point: Point
    quadratic: Quadratic
    weights: Weights
    motions: list[Motion]
    iterations: int


@use_one_blas_thread()
def refine(
    objective: Objective,
    start: Point,
    *,
    steps: Steps = STEPS,
    progress: Callable[[float], None] | None = None,
) -> Refinement:
    """Minimise the objective from a start."""
    point = start
    motions = objective.motions(start)
    done = 0
    inflation = 1.0
    damping = steps.damping
    weights = derive_weights(objective, motions, steps, inflation)
    slopes = objective.slopes(point, motions)
    quadratic = objective.quadratic(point, motions, weights, slopes)
    for number in range(steps.rounds):
        inflation = max(1.0, inflation * score_inflation(quadratic, weights))
        renewed = derive_weights(objective, motions, steps, inflation)
        last = number == steps.rounds - 1 or (
            number > 0
            and bool(np.all(np.abs(np.log(renewed.joints / weights.joints)) < steps.same))
        )
        weights = renewed
        enough = steps.settled if last else steps.roughly
        quadratic = objective.quadratic(point, motions, weights, slopes)
        for _ in range(steps.most):
            if _is_settled(objective, point, quadratic, enough):
                break
            done += 1
            moved = _find_better_point(
                objective, point, motions, quadratic, weights, damping, steps
            )
            if moved is None:
                break
            point, motions, damping = moved
            slopes = objective.slopes(point, motions)
            before = quadratic.cost
            quadratic = objective.quadratic(point, motions, weights, slopes)
            if progress is not None:
                progress((number + done / (steps.most * steps.rounds)) / steps.rounds)
            if before - quadratic.cost < enough:
                break
        if last:
            break
    return Refinement(point, quadratic, weights, motions, done)


def derive_weights(
    objective: Objective, motions: Sequence[Motion], steps: Steps, inflation: float
) -> Weights:
    """Return weights by the errors of the windows: of each joint, and less for outlying windows.

    Errors along a window are correlated; `inflation` is by how much the variance of the gradient
    exceeds the variance for independent errors.
    """
    errors = objective.errors(motions)
    variance = np.concatenate([np.mean(error**2, axis=1) for error in errors])
    typical = np.median(variance, axis=0) + np.finfo(float).tiny
    size = [np.sqrt(np.mean(np.mean(error**2, axis=1) / typical, axis=1)) for error in errors]
    usual = float(np.quantile(np.concatenate(size), steps.usual))
    share = [
        np.minimum(1.0, (steps.outlying * usual / np.maximum(each, 1e-300)) ** 2) for each in size
    ]
    spread = np.average(variance, axis=0, weights=np.concatenate(share)) + np.finfo(float).tiny
    return Weights(1.0 / (spread * inflation), tuple(share))


def score_inflation(quadratic: Quadratic, weights: Weights) -> float:
    """Return how many times their information the scores of windows vary.

    The windows of a recording share what the model gets wrong about its motion. From four
    recordings on, the scores of whole recordings count where they vary more.
    """
    scores = Scaled(quadratic.data).whiten(quadratic.scores.T).T
    found = float(np.mean(np.sum(scores**2, axis=0)))
    g = len(weights.windows)
    if g < FEWEST_RECORDINGS:
        return found
    ends = np.cumsum([len(window) for window in weights.windows])[:-1]
    whole = np.stack([each.sum(axis=0) for each in np.split(scores, ends)])
    return max(found, g / (g - 1.0) * float(np.mean(np.sum(whole**2, axis=0))))


def _is_settled(objective: Objective, point: Point, quadratic: Quadratic, enough: float) -> bool:
    """Return whether parameters, and on average starts, are close to their minimum."""
    free = ~objective.at_bound(point, quadratic.gradient)
    starts = sum(start.size for start in point.starts)
    return quadratic.fall(free) < enough and quadratic.gain < enough * starts


def _find_better_point(
    objective: Objective,
    point: Point,
    motions: Sequence[Motion],
    quadratic: Quadratic,
    weights: Weights,
    damping: float,
    steps: Steps,
) -> tuple[Point, list[Motion], float] | None:
    """Return a better point, its motions and the next damping; None if there is none."""
    free = np.flatnonzero(~objective.at_bound(point, quadratic.gradient))
    H = quadratic.matrix[np.ix_(free, free)]
    g = quadratic.gradient[free]
    scale = np.diag(H)
    before = objective.window_costs(point, motions, weights)
    while damping < steps.strongest:
        step = np.zeros(objective.size)
        step[free] = -np.linalg.solve(H + damping * np.diag(scale), g)
        # starts are damped as a whole: they are nearly linear
        full = objective.starts_after(point, quadratic, step)
        starts = tuple(
            old + (new - old) / (1.0 + damping) for old, new in zip(point.starts, full, strict=True)
        )
        tried = objective.moved(point, step, starts)
        moved = objective.motions(tried)
        found = _try_point(objective, point, before, tried, moved, weights, quadratic.cost)
        if found is not None:
            return *found, damping / 30.0
        damping = max(10.0 * damping, 0.1 * steps.damping)
    return None


def _try_point(
    objective: Objective,
    point: Point,
    before: Sequence[Array],
    tried: Point,
    motions: list[Motion],
    weights: Weights,
    limit: float,
) -> tuple[Point, list[Motion]] | None:
    """Return a tried point whose cost is below the limit, and its motions; None if it is not.

    Where a joint comes to rest or breaks away, a motion is not smooth in its start. Few windows
    would then forbid a step that is good for all others: these keep more of their old start.
    """
    other = objective.other_cost(tried)
    for share in (*KEPT, None):
        after = objective.window_costs(tried, motions, weights)
        # What the cost of a window that diverges counts as, in units of the logarithmic likelihood.
        rise = [
            np.minimum(np.nan_to_num(new - old, nan=np.inf), 1e12)
            for new, old in zip(after, before, strict=True)
        ]
        all_rises = np.sort(np.concatenate(rise))[::-1]
        excess = other + float(sum(np.sum(each) for each in (*before, *rise))) - limit
        if excess < 0.0:
            return tried, motions
        few = int(np.searchsorted(np.cumsum(all_rises), excess, side="right")) + 1
        if share is None or few > FEW * len(all_rises):
            return None
        worst = [np.flatnonzero(each >= all_rises[few - 1]) for each in rise]
        starts = [start.copy() for start in tried.starts]
        for new, old, at in zip(starts, point.starts, worst, strict=True):
            new[at] = share * old[at] + (1.0 - share) * new[at]
        tried = replace(tried, starts=tuple(starts))
        motions = [
            motion.replaced(at, part)
            for motion, at, part in zip(
                motions, worst, objective.motions(tried, worst), strict=True
            )
        ]
    return None
