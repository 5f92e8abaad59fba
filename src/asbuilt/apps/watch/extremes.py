"""Level that block maxima exceed at a stated rate: peaks over a threshold, predictive.

Block maxima above a high quantile follow a generalised Pareto distribution (Pickands, 1975; Coles,
2001, chapter 4): `P(x > u + y | x > u) = (1 + shape y / scale)^(-1/shape)`. With few blocks the
error of shape and scale matters more than their values, so exceedance probabilities are averaged
over their posterior; a level of predictive probability p is then exceeded with probability p on
average over data sets. With the (k + 1)-th largest of B maxima as u, `P(x > u)` is on average
`(k + 1) / (B + 1)`, whatever their distribution, and independent of the k excesses if the tail is
exponential (Renyi, 1953); with a shape of 0 and excesses of sum T then exactly

    P(x > u + y) = (k + 1) / (B + 1) (1 + y / T)^(-k),

which exceeds `k / B exp(-k y / T)`, what the estimates themselves would say.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from asbuilt.arrays import Array, Indices
from asbuilt.errors import RecordingError
from asbuilt.findings import Cure

# Hold when a tail is fitted, and its priors.

TAIL_FEWEST_BLOCKS = 20  # Blocks below which no tail is fitted
TAIL_FEWEST_PEAKS = 10  # Blocks that a tail has at least
# Standard deviation of the prior of the shape about 0, the exponential tail: torque errors are sums
# of many bounded causes
TAIL_SHAPE_ERROR = 0.1
# Least mean excess, per start of the tail: blocks that are alike, as of a joint at rest whose
# sensor repeats itself, do not show how the next ones differ
TAIL_LEAST_SPREAD = 0.05


TAILS = (0.02, 0.005)
"""Shares of the blocks that are taken as the tail, or `TAIL_FEWEST_PEAKS` of them; the highest
level counts. Rare states, such as reversals, have errors of their own, whose tail a fit to many
blocks does not see: on the iiwa and the Panda it begins at the largest half percent."""
SHAPES = np.linspace(-0.4, 0.4, 41)
SCALES = np.geomspace(0.25, 4.0, 61)
"""Scales of the posterior, in mean excesses."""


def block_maxima(t: Array, values: Array, seconds: float) -> Array:
    """Return the largest values (B, n) of blocks of `seconds`, without blocks less than half full.

    Parameters
    ----------
    t, values
        Times (N,) [s], increasing, and values (N, n).
    """
    starts, counts = divide_into_blocks(t, seconds)
    full = counts >= 0.5 * seconds / float(np.median(np.diff(t)))
    return np.asarray(np.maximum.reduceat(values, starts, axis=0)[full])


def divide_into_blocks(t: Array, seconds: float) -> tuple[Indices, Indices]:
    """Return the first samples of blocks of `seconds`, and their numbers of samples, two (B,)."""
    block = np.floor((t - t[0]) / seconds).astype(np.int64)
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    return starts, np.diff(np.append(starts, len(t)))


def tail_level(maxima: Array, probability: float, shares: Sequence[float] = TAILS) -> float:
    """Return the level that the next block maximum exceeds with a stated probability.

    Parameters
    ----------
    maxima
        Block maxima (B,), independent and of one distribution.
    probability
        Probability that one more block exceeds the level.
    shares
        Shares of the blocks that are taken as the tail; the highest level counts.

    Raises
    ------
    RecordingError
        If there are too few blocks.

    Examples
    --------
    >>> maxima = -np.log(np.random.default_rng(0).uniform(size=2000))
    >>> bool(abs(tail_level(maxima, 1e-3) / np.log(1000.0) - 1.0) < 0.1)
    True
    """
    x = np.sort(maxima)
    blocks = len(x)
    if blocks < TAIL_FEWEST_BLOCKS:
        raise RecordingError(
            f"{blocks} blocks are too few for the tail of the residual; at least"
            f" {TAIL_FEWEST_BLOCKS} are needed",
            cure=Cure("give a longer recording without contact"),
            value=blocks,
            expected=TAIL_FEWEST_BLOCKS,
        )
    return max(_fit_tail(x, _count_peaks(blocks, share), probability) for share in shares)


def _fit_tail(x: Array, peaks: int, probability: float) -> float:
    """Return the level of sorted maxima x (B,) from the tail of the largest `peaks`."""
    start, mean = _find_tail(x, peaks)
    above = (peaks + 1) / (len(x) + 1)
    # At the start of the tail rounding decides on which side of it the level is.
    if probability > (1.0 - 1e-12) * above:
        return float(np.quantile(x, 1.0 - probability))
    posterior = _evaluate_posterior((x[-peaks:] - start) / mean)

    def excess(y: float) -> float:
        return above * _evaluate_survival(y, *posterior) - probability

    high = 1.0
    while excess(high) > 0.0 and high < 1e9:
        high *= 2.0
    return start + mean * (brentq(excess, 0.0, high, xtol=1e-300) if excess(high) < 0.0 else high)


def select_largest(maxima: Array) -> Array:
    """Return the largest `TAILS[0]` of maxima (B,), at least `TAIL_FEWEST_PEAKS`, in order."""
    return np.sort(maxima)[-_count_peaks(len(maxima), TAILS[0]) :]


def _count_peaks(blocks: int, share: float) -> int:
    """Return how many maxima of blocks are the tail of a share of them."""
    return min(max(round(share * blocks), TAIL_FEWEST_PEAKS), blocks // 2)


def exponential_level(maxima: Array, probability: float) -> float:
    """Return the level that maxima (B,) exceed at a probability if their tail is exponential."""
    x = np.sort(maxima)
    peaks = len(select_largest(maxima))
    start, mean = _find_tail(x, peaks)
    return start + mean * max(float(np.log(peaks / (len(x) * probability))), 0.0)


def _find_tail(x: Array, peaks: int) -> tuple[float, float]:
    """Return the start and the mean excess of the tail of the largest `peaks` of sorted maxima."""
    start = float(x[-peaks - 1])
    mean = float(np.mean(x[-peaks:] - start))
    return start, max(mean, TAIL_LEAST_SPREAD * start, np.finfo(float).tiny)


def gumbel_level(maxima: Array, probability: float) -> float:
    """Return the level of a Gumbel distribution through the first and fifth decile of maxima (B,).

    It ignores the upper half of the blocks, so contacts in fewer than half do not move it much.
    """
    low, middle = np.quantile(maxima, [0.1, 0.5])
    scale = (middle - low) / (np.log(np.log(10.0)) - np.log(np.log(2.0)))
    place = middle + scale * np.log(np.log(2.0))
    return float(place - scale * np.log(-np.log1p(-probability)))


def _evaluate_posterior(y: Array) -> tuple[Array, Array, Array]:
    """Return shapes, scales and weights (K,) for excesses y (m,) of mean 1; flat in log scale."""
    shape, scale = (grid.ravel() for grid in np.meshgrid(SHAPES, SCALES, indexing="ij"))
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = np.maximum(1.0 + shape[:, None] * y / scale[:, None], 0.0)
        power = np.where(
            np.abs(shape)[:, None] < 1e-9,
            y / scale[:, None],
            (1.0 + 1.0 / np.where(shape == 0.0, 1.0, shape))[:, None] * np.log(inside),
        )
    likelihood = -len(y) * np.log(scale) - power.sum(axis=1) - 0.5 * (shape / TAIL_SHAPE_ERROR) ** 2
    likelihood[~np.isfinite(likelihood) | np.any(inside <= 0.0, axis=1)] = -np.inf
    weight = np.exp(likelihood - likelihood.max())
    return shape, scale, weight / weight.sum()


def _evaluate_survival(y: float, shape: Array, scale: Array, weight: Array) -> float:
    inside = np.maximum(1.0 + shape * y / scale, 0.0)
    with np.errstate(divide="ignore", over="ignore"):
        exponent = np.where(
            np.abs(shape) < 1e-9, -y / scale, -np.log(inside) / np.where(shape == 0, 1.0, shape)
        )
    return float(np.sum(weight * np.where(inside > 0.0, np.exp(exponent), 0.0)))
