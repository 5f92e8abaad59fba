"""The weight of CAD, chosen by the prediction of held-out time blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.bodies.entropic_path import DESCENT
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import triangular_factor

Fits = Callable[[Array, float], Array]
"""Fits `(factors (m, p + 1, p + 1), weight) -> chi (m, n_standard)`, by descending weight."""

WEIGHTS = DESCENT
"""Costs of a divergence of 1 from CAD, in squared weighted residuals, largest first."""
FEWEST_GROUPS = 3
"""Groups below which `DEFAULT_WEIGHT` is taken."""
DEFAULT_WEIGHT = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class WeightChoice:
    """Hold a weight, and the mean squared errors on held-out groups (n_weights, n_groups)."""

    weight: float
    weights: tuple[float, ...]
    errors: Array
    reason: str


def choose_weight(
    information: SquareRootInformation,
    joint_weights: Array,
    regrouping: Array,
    fits: Fits,
    weights: tuple[float, ...] = WEIGHTS,
) -> WeightChoice:
    """Return the largest weight whose held-out error is within one standard error of the least.

    The blocks form up to 8 groups of neighbours; each is predicted from the others with every
    weight. The error of a group is `|w (tau - W beta)|^2 / (N n)`; the standard error is that of
    the mean difference from the best weight, group by group (the one-standard-error rule of
    Breiman, Friedman, Olshen & Stone, 1984, section 3.4.3, on paired errors; Hastie, Tibshirani &
    Friedman, 2009, section 7.10).
    """
    # Groups of neighbouring blocks that are held out.
    n_groups = min(8, information.n_blocks)
    if n_groups < FEWEST_GROUPS:
        return WeightChoice(
            DEFAULT_WEIGHT,
            (DEFAULT_WEIGHT,),
            np.zeros((1, 0)),
            f"weight of CAD {DEFAULT_WEIGHT:g}, the default: {information.n_blocks} time blocks are"
            f" too few to choose it, {FEWEST_GROUPS} are needed",
        )
    groups = np.array_split(np.arange(information.n_blocks), n_groups)
    held = np.array([information.select(group).stacked(joint_weights) for group in groups])
    factors = _without_each(held)
    counts = (
        np.array([sum(information.blocks[b].n_samples for b in group) for group in groups])
        * information.n_joints
    )
    errors = np.empty((len(weights), n_groups))
    for row, weight in enumerate(weights):
        beta = fits(factors, weight) @ regrouping.T
        residuals = (held[:, :, :-1] @ beta[:, :, None])[:, :, 0] - held[:, :, -1]
        errors[row] = np.sum(residuals**2, axis=1) / counts
    means = errors.mean(axis=1)
    best = int(np.argmin(means))
    excess = errors - errors[best]
    standard_error = excess.std(axis=1, ddof=1) / np.sqrt(n_groups)
    chosen = int(np.flatnonzero(excess.mean(axis=1) <= standard_error)[0])
    if chosen == best:
        why = f"the least error, {means[best]:.3g}, on {n_groups} groups of held-out time blocks"
    else:
        why = (
            f"the largest of {len(weights)} whose error on {n_groups} groups of held-out time"
            f" blocks, {means[chosen]:.3g}, is within one standard error"
            f" ({standard_error[chosen]:.2g}) of the least, {means[best]:.3g} at {weights[best]:g}"
        )
    return WeightChoice(
        weights[chosen], weights, errors, f"weight of CAD {weights[chosen]:g}: {why}"
    )


def _without_each(factors: Array) -> Array:
    """Return the triangular factors of all but each, (m, p + 1, p + 1)."""

    def joined(one: Array, other: Array) -> Array:
        return triangular_factor(np.vstack([one, other]))

    before, after = [*accumulate(factors[:-1], joined)], [*accumulate(factors[:0:-1], joined)][::-1]
    between = [joined(one, other) for one, other in zip(before[:-1], after[1:], strict=True)]
    return np.array([after[0], *between, before[-1]])
