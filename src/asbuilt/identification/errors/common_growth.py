"""What makes the variances from all time blocks too small alike, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation

LIKE = 0.1
"""Relative distance of the information per sample below which blocks repeat a motion: 0.01 to 0.05
in one motion recorded twice, over 0.18 between other blocks of six real robots.
"""
LEAST_LEFT = 0.05
"""Least `(1 - 2 p D / N)^2`: a fit that absorbs more of its residuals is not corrected further."""


@dataclass(frozen=True, slots=True)
class CommonGrowth:
    """Hold a factor on all variances and the relative variance of that factor."""

    factor: float
    variance: float


def common_growth(
    information: SquareRootInformation,
    estimate: Estimate,
    moves: Array,
    grams: Array,
    leverage: float,
    freedom: float,
) -> CommonGrowth:
    """Return the factor by which block variances are too small, for three reasons.

    Successive blocks are correlated: `1 + 2 rho`. Blocks that repeat a motion share what the model
    lacks there, so that K pairs of B blocks add `2 K / B` times their correlation, as neighbours in
    space do (Conley, J. Econometrics 92, 1999): a motion recorded twice shows the noise twice, but
    the error of the model once. And a fit absorbs more of correlated residuals: N
    rows with design effect D (samples per independent sample) are worth N / D, so a fit of p
    parameters leaves 1 - p D / N of their energy, where CR2 allows for 1 - p / N. D follows from
    that of the moves, `D (1 - p D / N) = D_moves (1 - p / N)`.

    Parameters
    ----------
    information, estimate
        The data and the estimate.
    moves
        Scores of the blocks, corrected for leverage, (n_blocks, rank).
    grams
        Information of the blocks, (n_blocks, rank, rank).
    leverage
        Trace p of the hat matrix.
    freedom
        Degrees of freedom of the variance of one parameter.
    """
    variance = _unit_variance(estimate)
    if variance <= 0.0 or not np.any(moves):
        return CommonGrowth(1.0, 0.0)
    rank = effective_rank(moves)
    neighbours = _neighbours(information)
    repeated = repetitions(information, grams) - neighbours
    after, spread = _common_part(moves, neighbours, 2.0, 0.5)
    again, spread_again = _common_part(moves, repeated, 2.0 * len(repeated) / len(moves), 1.0)
    along, spread = 1.0 + after + again, (spread + spread_again) / rank
    share = leverage / max(information.n_samples * information.n_joints, 1)
    seen = along * float(np.sum(moves**2)) / (moves.shape[1] * variance)
    grown, steep = _absorbed(share, seen)
    spread /= along**2
    of_moves = 2.0 / (rank * freedom)
    return CommonGrowth(along * grown, steep**2 * spread + (steep**2 - 1.0) * of_moves)


def effective_rank(moves: Array) -> float:
    """Return `tr(O)^2 / tr(O^2)` of `O = sum_b g_b g_b^T`, between 1 and the number of columns.

    Products of *different* blocks give `tr(O^2)` without bias (Chen & Qin, Annals of Statistics 38,
    2010).
    """
    products, n = moves @ moves.T, len(moves)
    own = np.diag(products)
    across = float((products**2).sum() - (own**2).sum()) * n / max(n - 1, 1)
    trace = float(own.sum())
    return float(np.clip(trace**2 / max(across, 1e-12 * trace**2), 1.0, moves.shape[1]))


def _absorbed(share: float, seen: float) -> tuple[float, float]:
    """Return the factor for absorbed residuals, and its slope: d log D / d log D_moves."""
    left = 1.0 - 4.0 * share * seen * (1.0 - share)
    if share <= 0.0:
        return 1.0, 1.0
    root = np.sqrt(max(left, LEAST_LEFT))
    grown = (1.0 - root) / (0.5 * (1.0 - max(left, LEAST_LEFT)) / (1.0 - share))
    return max(float(grown), 1.0), float((1.0 - share) / root / grown) if left > LEAST_LEFT else 1.0


def _unit_variance(estimate: Estimate) -> float:
    """Return the variance of a whitened parameter by the textbook."""
    length = float(np.sum(estimate.solution.inverse_root**2))
    return float(np.trace(estimate.covariance)) / length if length > 0.0 else 0.0


def repetitions(information: SquareRootInformation, grams: Array) -> set[tuple[int, int]]:
    """Return the pairs of blocks that repeat a motion: their information per sample is alike."""
    samples = np.array([block.n_samples for block in information.blocks], dtype=np.float64)
    features = (grams / samples[:, None, None]).reshape(len(grams), -1)
    products = features @ features.T
    size = np.diag(products)
    total = size[:, None] + size
    apart = np.maximum(total - 2.0 * products, 0.0)
    first, second = np.nonzero(np.triu(apart < LIKE**2 * total, 1))
    return set(zip(first.tolist(), second.tolist(), strict=True))


def _neighbours(information: SquareRootInformation) -> set[tuple[int, int]]:
    """Return the pairs of successive blocks."""
    blocks = information.blocks
    return {
        (b, b + 1)
        for b in range(len(blocks) - 1)
        if blocks[b].source == blocks[b + 1].source
        and 0.0 <= blocks[b + 1].start - blocks[b].stop < 0.5 * (blocks[b].stop - blocks[b].start)
    }


def _common_part(
    moves: Array, pairs: set[tuple[int, int]], weight: float, largest: float
) -> tuple[float, float]:
    """Return `weight` times the correlation of pairs, and its variance for scores of one column.

    The correlation is between 0 and `largest`. The residuals of a fit sum to zero, which alone
    gives the scores of B blocks a correlation of -1 / (B - 1); that is added back.
    """
    n, energy = len(moves), float(np.sum(moves**2)) / len(moves)
    if not pairs or energy == 0.0:
        return 0.0, 0.0
    first, second = np.array(sorted(pairs)).T
    along = float(np.mean(np.sum(moves[first] * moves[second], axis=1))) / energy
    correlation = float(np.clip(along + 1.0 / (n - 1), 0.0, largest))
    return weight * correlation, weight**2 / len(pairs)
