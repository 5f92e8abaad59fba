"""What makes the variances from all time blocks too small alike, and how well that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.identification.information.rows import TimeBlock

LEAST_LEFT = 0.05
"""Least `(1 - 2 p D / N)^2`: a fit that absorbs more of its residuals is not corrected further."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockScores:
    """Hold what each of B time blocks says of r unknowns of a fit, all of them, nuisance too.

    Parameters
    ----------
    grams, scores
        `L^T W_b^T W_b L` (B, r, r) and `L^T W_b^T e_b` (B, r) of the weighted residual e, with the
        inverse root L that makes the sum of the `grams` one.
    blocks
        Their times.
    alike
        The blocks in groups of like motion.
    n_rows
        Number of torques.
    variance
        Variance of a weighted residual.
    """

    grams: Array
    scores: Array
    blocks: Sequence[TimeBlock]
    alike: Sequence[Indices]
    n_rows: int
    variance: float


@dataclass(frozen=True, slots=True)
class CommonGrowth:
    """Hold a factor on all variances and the relative variance of that factor.

    `of_noise` is the factor without what blocks of like motion share.
    """

    factor: float
    variance: float
    of_noise: float = 1.0


def estimate_common_growth(
    data: BlockScores, moves: Array, absorbed: Array, leverage: float, freedom: float
) -> CommonGrowth:
    """Return the factor by which block variances are too small, for three reasons.

    Successive blocks are correlated, since noise lasts. Blocks that repeat a motion (with their
    successors), and less so blocks of like motion, share what the model lacks there, as neighbours
    in space do (Conley, J. Econometrics 92, 1999): a motion recorded twice shows the noise twice,
    but the error of the model once. All add twice the sum of `g_b . g_c` over pairs of blocks to
    that of `g_b . g_b`. And a fit absorbs more of correlated residuals: N rows with design effect D
    (samples per independent sample) are worth N / D, so a fit of p parameters leaves 1 - p D / N of
    their energy, where CR2 allows for 1 - p / N. D follows from that of the moves,
    `D (1 - p D / N) = D_moves (1 - p / N)`.

    Parameters
    ----------
    data
        The blocks.
    moves
        Scores of the blocks, corrected for leverage, `(1 - M_b)^(-1/2) g_b`, (n_blocks, rank).
    absorbed
        `(1 - M_b)^(-1/2) M_b`, (n_blocks, rank, rank): by their products the fit makes moves of
        two blocks opposite where residuals are independent.
    leverage
        Trace p of the hat matrix.
    freedom
        Degrees of freedom of the variance of one parameter.
    """
    if data.variance <= 0.0 or not np.any(moves):
        return CommonGrowth(1.0, 0.0)
    rank = effective_rank(moves)
    after = _find_successive(data.blocks)
    again = np.triu(_extend_to_successors(find_repetitions(data), after), 1) & ~after
    alike = _pair_like_motion(data.alike, len(moves)) & ~after & ~again
    products, taken, spreads = _add_pairs(moves, absorbed, leverage, (after, again, alike))
    parts = products + taken
    of_noise = 1.0 + float(np.clip(parts[0], 0.0, 1.0))
    # Of what blocks share beyond chance the fit takes its part too. Least part that it leaves: of
    # few motions it absorbs almost all.
    left = np.maximum(1.0 - taken[1:], 0.3)
    x, v = parts[1:] / left, spreads[1:] / rank / left**2
    beyond = x - np.divide(v, x, out=np.zeros_like(x), where=x > 0.0)
    along = of_noise + float(np.maximum(beyond, 0.0).sum())
    share = leverage / max(data.n_rows, 1)
    seen = float(np.sum(moves**2)) / (moves.shape[1] * data.variance)
    grown, steep = _evaluate_absorption(share, along * seen)
    spread = spreads.sum() / rank / along**2
    of_moves = 2.0 / (rank * freedom)
    return CommonGrowth(
        along * grown,
        steep**2 * spread + (steep**2 - 1.0) * of_moves,
        of_noise * _evaluate_absorption(share, of_noise * seen)[0],
    )


def effective_rank(moves: Array) -> float:
    """Return `tr(O)^2 / tr(O^2)` of `O = sum_b g_b g_b^T`, between 1 and the number of columns.

    Products of *different* blocks give `tr(O^2)` without bias (Chen & Qin, Annals of Statistics 38,
    2010).
    """
    products, n = moves @ moves.T, len(moves)
    own, trace = np.diag(products), float(np.trace(products))
    across = float((products**2).sum() - (own**2).sum()) * n / max(n - 1, 1)
    return float(np.clip(trace**2 / max(across, 1e-12 * trace**2), 1.0, moves.shape[1]))


def _evaluate_absorption(share: float, seen: float) -> tuple[float, float]:
    """Return the factor for absorbed residuals, and its slope: d log D / d log D_moves."""
    left = 1.0 - 4.0 * share * seen * (1.0 - share)
    if share <= 0.0 or left >= 1.0:
        return 1.0, 1.0
    root = np.sqrt(max(left, LEAST_LEFT))
    grown = (1.0 - root) / (0.5 * (1.0 - max(left, LEAST_LEFT)) / (1.0 - share))
    return max(float(grown), 1.0), float((1.0 - share) / root / grown) if left > LEAST_LEFT else 1.0


def find_repetitions(data: BlockScores) -> Mask:
    """Return which pairs of blocks repeat a motion, the first lower, shape (n_blocks, n_blocks).

    Their information per sample is alike.
    """
    samples = np.array([block.n_samples for block in data.blocks], dtype=np.float64)
    features = (data.grams / samples[:, None, None]).reshape(len(samples), -1)
    products = features @ features.T
    total = np.add.outer(np.diag(products), np.diag(products))
    apart = np.maximum(total - 2.0 * products, 0.0)
    # Relative distance of the information per sample below which blocks repeat a motion: 0.01 to
    # 0.05 in one motion recorded twice, over 0.18 between other blocks of six real robots.
    return np.asarray(np.triu(apart < 0.1**2 * total, 1))


def _add_pairs(
    moves: Array, absorbed: Array, leverage: float, masks: Sequence[Mask]
) -> tuple[Array, Array, Array]:
    """Return twice the sum of products over pairs of blocks, over that of each with itself.

    For each mask of pairs: that sum, what the fit takes from it where residuals are independent,
    and its variance for independent blocks with moves of one column.
    """
    products, flat = moves @ moves.T, absorbed.reshape(len(moves), -1)
    energy = np.diag(products)
    whole = float(energy.sum())
    taken = float(np.trace(products)) / leverage * (flat @ flat.T)
    return (
        np.array([2.0 * products[which].sum() / whole for which in masks]),
        np.array([2.0 * taken[which].sum() / whole for which in masks]),
        np.array([4.0 * (energy @ which @ energy) / whole**2 for which in masks]),
    )


def _find_successive(blocks: Sequence[TimeBlock]) -> Mask:
    """Return which pairs of blocks are successive, the first lower."""
    found = np.zeros((len(blocks),) * 2, dtype=np.bool_)
    for b, (block, other) in enumerate(pairwise(blocks)):
        found[b, b + 1] = block.source == other.source and 0.0 <= other.start - block.stop < 0.5 * (
            block.stop - block.start
        )
    return found


def _extend_to_successors(repeated: Mask, after: Mask) -> Mask:
    """Return pairs that repeat a motion, and those of one block and the successor of the other.

    What successive blocks share in one recording is shared across repetitions too.
    """
    both = repeated | repeated.T
    found = both.copy()
    found[:, 1:] |= both[:, :-1] & np.diag(after, 1)
    return found | found.T


def _pair_like_motion(groups: Sequence[Indices], n_blocks: int) -> Mask:
    """Return which pairs of blocks are in the same group of like motion, the first lower."""
    number = np.empty(n_blocks, dtype=np.int64)
    for k, group in enumerate(groups):
        number[group] = k
    return np.asarray(np.triu(number[:, None] == number, 1))
