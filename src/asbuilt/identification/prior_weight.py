"""How much to trust CAD: chosen by predicting time blocks that were held out, without a second look at the samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.identification.square_root_information import SquareRootInformation

Array = NDArray[np.float64]
Fit = Callable[[Array, float, Array | None], Array]
"""A fit `(factor, weight, warm start or None) -> chi`."""

WEIGHTS: tuple[float, ...] = tuple(10.0**exponent for exponent in range(6, -2, -1))
"""Weights to choose from, strongest first: what a divergence of 1 from CAD costs, in units of the squared weighted residual."""
MOST_GROUPS = 8
"""The blocks are held out in so many groups of neighbours,"""
FEWEST_GROUPS = 3
"""and with fewer the default weight is taken."""
DEFAULT_WEIGHT = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class WeightChoice:
    """Hold the weight chosen, and the mean squared weighted error on held-out groups, (n_weights, n_groups), by which it was."""

    weight: float
    weights: tuple[float, ...]
    errors: Array
    reason: str


def choose_weight(
    information: SquareRootInformation, joint_weights: Array, regrouping: Array, fit: Fit, weights: tuple[float, ...] = WEIGHTS
) -> WeightChoice:
    """Return the strongest trust in CAD that predicts held-out time blocks as well as the best, within one standard error of the difference.

    The blocks form up to 8 groups of neighbours; each is predicted from the others with every weight. The error of a group is `|w (tau - W beta)|^2 / (N n)`;
    the standard error is that of the mean difference from the best weight, group by group (the one-standard-error rule of Breiman, Friedman, Olshen & Stone,
    1984, section 3.4.3, on paired errors; Hastie, Tibshirani & Friedman, 2009, section 7.10).
    """
    n_groups = min(MOST_GROUPS, information.n_blocks)
    if n_groups < FEWEST_GROUPS:
        return WeightChoice(
            DEFAULT_WEIGHT,
            (DEFAULT_WEIGHT,),
            np.zeros((1, 0)),
            f"weight of CAD {DEFAULT_WEIGHT:g}, the default: {information.n_blocks} time blocks are too few to choose it",
        )
    groups = np.array_split(np.arange(information.n_blocks), n_groups)
    errors = np.empty((len(weights), n_groups))
    for g, group in enumerate(groups):
        held = information.select(group)
        factor = information.select(np.setdiff1d(np.arange(information.n_blocks), group)).stacked(joint_weights)
        chi = None
        for row, weight in enumerate(weights):
            chi = fit(factor, weight, chi)
            energy = held.residual_energy(regrouping @ chi)
            errors[row, g] = float(joint_weights**2 @ energy) / (held.n_samples * held.n_joints)
    means = errors.mean(axis=1)
    best = int(np.argmin(means))
    excess = errors - errors[best]
    standard_error = excess.std(axis=1, ddof=1) / np.sqrt(n_groups)
    chosen = int(np.flatnonzero(excess.mean(axis=1) <= standard_error)[0])
    return WeightChoice(
        weights[chosen],
        weights,
        errors,
        f"weight of CAD {weights[chosen]:g}: the strongest of {len(weights)} whose error on {n_groups} held-out groups of time blocks, {means[chosen]:.3g}, lies within "
        f"one standard error ({standard_error[chosen]:.2g}) of the least, {means[best]:.3g} at {weights[best]:g}",
    )
