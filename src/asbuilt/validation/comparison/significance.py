"""Multiple tests, and tests of vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, fdtrc

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.identification.uncertainty.block_scatter import effective_rank, student_probability
from asbuilt.scaled import Scaled
from asbuilt.tables import round_significant

RESOLUTION = 0.1
"""Difference, relative to its size, up to which a number is as claimed whatever its standard error:
filters and delays of a log bias by several percent, and tuned numbers claim no more; own choice.
Numbers of a description and sums of them (base parameters) are tested by it alike."""


def benjamini_hochberg(probabilities: ArrayLike) -> Array:
    """Return the false discovery rate at which each hypothesis would be the last to be rejected.

    `min_{j >= i} m p_(j) / j`.

    Among hypotheses with a value of at most 0.05, 5 % are expected to be rejected wrongly
    (Benjamini & Hochberg, J. Royal Stat. Soc. B 57, 1995).

    >>> benjamini_hochberg([0.01, 0.04, 0.03]).round(3).tolist()
    [0.03, 0.04, 0.04]
    """
    p, order = _sort_values(probabilities)
    # From the largest on, as a smaller one may be rejected where a larger one is.
    stepped = np.minimum.accumulate((p * len(p) / np.arange(1, len(p) + 1))[::-1])[::-1]
    return np.minimum(stepped, 1.0)[np.argsort(order)]


def holm(probabilities: ArrayLike) -> Array:
    """Return probabilities adjusted for the familywise error, `max_{j <= i} (m - j + 1) p_(j)`.

    Source: Holm, Scandinavian J. Statistics 6, 1979.

    >>> holm([0.01, 0.04, 0.03]).round(3).tolist()
    [0.03, 0.06, 0.06]
    """
    p, order = _sort_values(probabilities)
    # From the smallest on: the first that holds keeps all larger ones.
    stepped = np.maximum.accumulate(p * np.arange(len(p), 0, -1))
    return np.minimum(stepped, 1.0)[np.argsort(order)]


def compare_each(
    difference: Array, std_errors: Array, degrees_of_freedom: Array, tested: Mask
) -> Array:
    """Return the tests of p differences, each by itself, (4, p); NaN where none is `tested`.

    The rows are the difference in standard errors, its probability by Student's distribution, and
    the same for as many tests by Benjamini and Hochberg, and by Holm.
    """
    found = np.full((4, len(tested)), np.nan)
    sigmas = difference[tested] / std_errors[tested]
    p = student_probability(sigmas, degrees_of_freedom[tested])
    found[:, tested] = sigmas, p, benjamini_hochberg(p), holm(p)
    return found


def _sort_values(probabilities: ArrayLike) -> tuple[Array, Indices]:
    """Return values in ascending order, and the place that each of them had."""
    p = np.asarray(probabilities, dtype=np.float64)
    order = np.argsort(p)
    return p[order], order


@dataclass(frozen=True, slots=True)
class ChiSquare:
    """Hold a Wald statistic `d^T C^+ d`, its degrees of freedom (rank of C) and p value.

    If C is estimated from time blocks, p is the probability of `statistic / degrees` under F with
    `f_degrees`; otherwise these are None and p follows chi-square.
    """

    statistic: float
    degrees: int
    probability: float
    f_degrees: tuple[float, float] | None = None

    @property
    def text(self) -> str:
        """The statistic with its p value."""
        p = f"p {format_probability(self.probability)}"
        if self.f_degrees is None:
            return (
                f"chi-square {round_significant(self.statistic)} with {self.degrees} degrees of"
                " freedom,"
                f" {p}"
            )
        first, second = (round_significant(degree, 3) for degree in self.f_degrees)
        ratio = round_significant(self.statistic / max(self.degrees, 1))
        return f"F {ratio} with {first} and {second} degrees of freedom, {p}"


def chi_square(
    difference: ArrayLike, covariance: ArrayLike, degrees_of_freedom: float = np.inf
) -> ChiSquare:
    """Test whether a vector (p,) with covariance (p, p), singular or not, is zero (Wald, 1943).

    Each estimated variance has `degrees_of_freedom`.

    >>> test = chi_square([2.0, 0.0], np.eye(2))
    >>> test.statistic, test.degrees, round(test.probability, 3)
    (4.0, 2, 0.135)
    """
    d = np.asarray(difference, dtype=np.float64)
    C = np.asarray(covariance, dtype=np.float64)
    # Parameters without variance are not tested.
    known = np.diag(C) > 0
    if not known.any():
        return ChiSquare(0.0, 0, 1.0)
    known_part = Scaled(C[np.ix_(known, known)])
    statistic = known_part.square(d[known])
    rank = known_part.rank
    return ChiSquare(
        statistic,
        rank,
        _evaluate_tail(statistic / rank, rank, degrees_of_freedom),
        (float(rank), rank * degrees_of_freedom) if np.isfinite(degrees_of_freedom) else None,
    )


def joint_test(
    difference: ArrayLike,
    covariance: ArrayLike,
    moves: ArrayLike,
    degrees_alone: ArrayLike,
    common_variance: float = 0.0,
) -> ChiSquare:
    """Test whether a vector (p,) is zero, given the errors of independent blocks, (B, p).

    With u the vector and g_b the errors whitened by the textbook covariance (p, p), `F = |u|^2 /
    tr(O)`, `O = sum_b g_b g_b^T`, has about `f = tr(O)^2 / tr(O^2)` degrees of freedom (Box, Annals
    of Math. Statistics 25, 1954; Brunner, Dette & Munk, JASA 92, 1997). B may be less than p, where
    Hotelling's statistic is undefined. The denominator has the relative variance `2 / (f nu)`, nu
    the mean of `degrees_alone` (p,), no more than blocks of such unequal size have, and the
    relative variance of the factor common to all variances.

    >>> rng = np.random.default_rng(1)
    >>> test = joint_test([0.0, 0.0], np.eye(2), rng.normal(size=(20, 2)), [19.0, 19.0])
    >>> test.statistic, test.probability
    (0.0, 1.0)
    """
    d, C, M = (np.asarray(values, dtype=np.float64) for values in (difference, covariance, moves))
    known = np.diag(C) > 0
    if not known.any() or not np.any(M[:, known]):
        return ChiSquare(0.0, 0, 1.0)
    errors = Scaled(C[np.ix_(known, known)])
    # Whitened by the textbook covariance: F does not depend on units.
    u = errors.whiten(d[known])
    g = errors.whiten(M[:, known].T).T
    block_squares = np.sum(g**2, axis=1)
    trace = float(block_squares.sum())
    f = effective_rank(g)
    rank = len(u)
    # Blocks of unequal size determine fewer variances than blocks are.
    unequal = trace**2 * (1.0 + 2.0 / f) / float((block_squares**2).sum())
    nu = min(float(np.mean(np.asarray(degrees_alone)[known])), unequal)
    # Relative variances add up: of the blocks, and of what is common to all.
    f2 = 2.0 / (2.0 / (f * nu) + common_variance)
    ratio = float(u @ u) / trace
    return ChiSquare(ratio * rank, rank, float(fdtrc(f, f2, ratio)), (f, f2))


def size_probability(
    vector: ArrayLike, covariance: ArrayLike, degrees_of_freedom: float = np.inf
) -> float:
    """Return the probability that a normal vector with covariance (m, m) is as long as `vector`.

    The squared length is a weighted sum of chi-square variables, approximated by one scaled
    chi-square variable of the same mean and variance (Satterthwaite, Biometrics Bulletin 2, 1946);
    by F if the covariance is estimated with some degrees of freedom.

    >>> round(size_probability([1.96], [[1.0]]), 3)
    0.05
    >>> round(size_probability([2.571], [[1.0]], 5.0), 3)
    0.05
    """
    v = np.asarray(vector, dtype=np.float64)
    C = np.asarray(covariance, dtype=np.float64)
    mean = float(np.trace(C))
    square = float(np.sum(C**2))
    if mean <= 0.0:
        # Without any error a difference is certain.
        return 0.0 if v.any() else 1.0
    return _evaluate_tail(float(v @ v) / mean, mean**2 / square, degrees_of_freedom)


def _evaluate_tail(ratio: float, degrees: float, of_variance: float) -> float:
    """Return the probability of a mean square of `degrees` values at least `ratio` times its own.

    `of_variance` are the degrees of freedom of the variance of each.
    """
    if np.isfinite(of_variance):
        return float(fdtrc(degrees, degrees * of_variance, ratio))
    return float(chdtrc(degrees, degrees * ratio))


def format_probability(p: float) -> str:
    """Return a probability with two digits, as text if it is too small for a number."""
    return "below 1e-300" if p < 1e-300 else f"{p:.2g}"
