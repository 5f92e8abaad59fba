"""How much to trust CAD.

Chosen by predicting time blocks that were held out, without a second look at the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import triangular_factor

Fits = Callable[[Array, float], Array]
"""Fits `(factors (m, p + 1, p + 1), weight) -> chi (m, n_standard)`, called for every weight in
turn.
"""

WEIGHTS: tuple[float, ...] = tuple(10.0**exponent for exponent in range(6, -2, -1))
"""Weights to choose from, strongest first.

What a divergence of 1 from CAD costs, in units of the squared weighted residual.
"""
MOST_GROUPS = 8
"""The blocks are held out in so many groups of neighbours,"""
FEWEST_GROUPS = 3
"""and with fewer the default weight is taken."""
DEFAULT_WEIGHT = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class WeightChoice:
    """Hold the weight chosen, and the mean squared weighted error on held-out groups, (n_weights,
    n_groups), by which it was.
    """

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
    """Return the strongest trust in CAD that predicts held-out time blocks as well as the best,
    within one standard error of the difference.

    The blocks form up to 8 groups of neighbours; each is predicted from the others with every
    weight. The error of a group is `|w (tau - W beta)|^2 / (N n)`; the standard error is that of
    the mean difference from the best weight, group by group (the one-standard-error rule of
    Breiman, Friedman, Olshen & Stone, 1984, section 3.4.3, on paired errors; Hastie, Tibshirani &
    Friedman, 2009, section 7.10).
    """
    n_groups = min(MOST_GROUPS, information.n_blocks)
    if n_groups < FEWEST_GROUPS:
        return WeightChoice(
            DEFAULT_WEIGHT,
            (DEFAULT_WEIGHT,),
            np.zeros((1, 0)),
            f"weight of CAD {DEFAULT_WEIGHT:g}, the default: {information.n_blocks} time blocks are"
            " too few to choose it",
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
    judged = f"on {n_groups} groups of time blocks held out in turn"
    if chosen == best:
        why = f"the best of {len(weights)} {judged}, with an error of {means[best]:.3g}"
    else:
        why = (
            f"the strongest of {len(weights)} whose error {judged}, {means[chosen]:.3g}, lies"
            f" within one standard error ({standard_error[chosen]:.2g}) of the least,"
            f" {means[best]:.3g} at {weights[best]:g}"
        )
    return WeightChoice(
        weights[chosen], weights, errors, f"weight of CAD {weights[chosen]:g}: {why}"
    )


def _without_each(factors: Array) -> Array:
    """Return the triangular factors of all but each, (m, p + 1, p + 1).

    Those before it joined with those after it.
    """

    def joined(one: Array, other: Array) -> Array:
        return triangular_factor(np.vstack([one, other]))

    before, after = [*accumulate(factors[:-1], joined)], [*accumulate(factors[:0:-1], joined)][::-1]
    between = [joined(one, other) for one, other in zip(before[:-1], after[1:], strict=True)]
    return np.array([after[0], *between, before[-1]])
