"""Fits of a joint's servo rows in which blocks with other causes, such as contact, weigh less."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.identification.information.equations import Equations
from asbuilt.identification.servo.servo_rows import BLOCKS
from asbuilt.scaled import Scaled

CLUSTER = 5
"""Blocks together within which residuals are taken to be correlated."""


def fit_robust_residual(rows: Equations, k: int, used: Mask | None = None) -> Array:
    """Return the residual of a joint's fit to the blocks `used`, as a combination of its rows."""
    counting = np.ones(rows.n_blocks) if used is None else used.astype(np.float64)
    weight = counting
    # 4: passes of the robust weights, own choice.
    for _ in range(4):
        gram = rows.of_joint(k, weight)
        x = Scaled(gram[:-1, :-1]).solve(gram[:-1, -1])
        weight = counting * block_weights(rows, k, np.append(-x, 1.0))
    return np.append(-x, 1.0)


def usual_variances(rows: Equations, joints: Indices) -> Array:
    """Return the median mean square of the residuals of each joint over blocks (n,), else 1."""
    usual = np.ones(rows.n_joints)
    for k in joints.tolist():
        variances = block_variances(rows, k, fit_robust_residual(rows, k))
        if np.any(np.isfinite(variances)):
            # Exact simulations have residuals of zero, of which no ratio exists.
            usual[k] = max(float(np.nanmedian(variances)), 1e-300)
    return usual


def refine_minimum(
    costs: Callable[[float], Array], best: float, ratio: float, tolerance: float
) -> float:
    """Return the positive value of least cost within a ratio of the best that was tried."""
    minimum = minimize_scalar(
        # The logarithm: widths, limits and stiffnesses have a size, and no sign.
        lambda x: float(np.sum(costs(float(np.exp(x))))),
        bounds=np.log(best) + np.log(ratio) * np.array([-1.0, 1.0]),
        method="bounded",
        options={"xatol": tolerance},
    )
    return float(np.exp(minimum.x))


def logarithmic_error(costs: Callable[[float], Array], value: float, rows: Equations) -> float:
    """Return the standard error of the logarithm of a value, from the scores of the blocks.

    `costs` returns the costs of the blocks, (B,) or (joints, B).
    """
    step = 0.05
    up, here, down = (
        np.atleast_2d(costs(float(value * np.exp(s * step)))).sum(axis=0)
        for s in (1.0, 0.0, -1.0)
        # Differences by the logarithm of the value: the error is relative.
    )
    scores = sum_clusters((up - down) / (2.0 * step), rows)
    curvature = float(np.sum(up + down - 2.0 * here)) / step**2
    # Sandwich: scatter of the scores over the curvature of the cost.
    return float(np.sqrt(np.sum(scores**2)) / curvature) if curvature > 0.0 else float("inf")


def block_variances(rows: Equations, k: int, residual: Array) -> Array:
    """Return the mean square in each block of a combination of joint k's rows (B,), NaN if few."""
    count = rows.counts[k]
    # The mean of few rows is mostly their fit.
    many = count >= BLOCKS.fewest
    return np.where(many, rows.energies(k, residual) / np.maximum(count, 1), np.nan)


def block_weights(rows: Equations, k: int, residual: Array) -> Array:
    """Return `1 / (1 + r / median(r))` with the residual variance r of a joint in each block."""
    left = block_variances(rows, k, residual)
    if np.all(np.isnan(left)):
        return np.ones(left.size)
    # A block of too few rows weighs as the median one does: 1 / (1 + 1).
    return np.nan_to_num(1.0 / (1.0 + left / max(float(np.nanmedian(left)), 1e-300)), nan=0.5)


def sum_clusters(scores: Array, rows: Equations) -> Array:
    """Return the sums of scores (B, ...) over neighbouring blocks, `CLUSTER` at a time."""
    sources = np.array([block.source for block in rows.blocks])
    # A cluster ends with its recording: residuals of two are not correlated.
    firsts = [k for k in range(len(scores)) if k % CLUSTER == 0 or sources[k] != sources[k - 1]]
    return np.asarray(np.add.reduceat(scores, firsts))
