"""Multiple tests, and tests of vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, ndtr

Array = NDArray[np.float64]

SMALLEST_EIGENVALUE = 1e-10
"""Eigenvalue of a correlation matrix, relative to the largest, that counts as zero."""


def two_sided_probability(sigmas: ArrayLike) -> Array:
    """Return the probability of a normal variable at least so many standard deviations off.

    >>> float(np.round(two_sided_probability(1.96), 3))
    0.05
    """
    return np.asarray(2.0 * ndtr(-np.abs(np.asarray(sigmas, dtype=np.float64))))


def benjamini_hochberg(probabilities: ArrayLike) -> Array:
    """Return the false discovery rate at which each hypothesis would be the last to be rejected.

    `min_{j >= i} m p_(j) / j`.

    Among hypotheses with a value of at most 0.05, 5 % are expected to be rejected wrongly
    (Benjamini & Hochberg, J. Royal Stat. Soc. B 57, 1995).

    >>> benjamini_hochberg([0.01, 0.04, 0.03]).round(3).tolist()
    [0.03, 0.04, 0.04]
    """
    p = np.asarray(probabilities, dtype=np.float64)
    order = np.argsort(p)
    stepped = np.minimum.accumulate((p[order] * len(p) / np.arange(1, len(p) + 1))[::-1])[::-1]
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def holm(probabilities: ArrayLike) -> Array:
    """Return probabilities adjusted for the familywise error, `max_{j <= i} (m - j + 1) p_(j)`.

    Source: Holm, Scandinavian J. Statistics 6, 1979.

    >>> holm([0.01, 0.04, 0.03]).round(3).tolist()
    [0.03, 0.06, 0.06]
    """
    p = np.asarray(probabilities, dtype=np.float64)
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


@dataclass(frozen=True, slots=True)
class ChiSquare:
    """Hold a Wald statistic `d^T C^+ d`, its degrees of freedom (rank of C) and p value."""

    statistic: float
    degrees: int
    probability: float


def chi_square(difference: ArrayLike, covariance: ArrayLike) -> ChiSquare:
    """Test whether a vector (p,) with covariance (p, p), singular or not, is zero (Wald, 1943).

    >>> test = chi_square([2.0, 0.0], np.eye(2))
    >>> test.statistic, test.degrees, round(test.probability, 3)
    (4.0, 2, 0.135)
    """
    d, C = np.asarray(difference, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    size = np.sqrt(np.diag(C))
    known = size > 0
    if not known.any():
        return ChiSquare(0.0, 0, 1.0)
    size = size[known]
    eigenvalues, vectors = np.linalg.eigh(C[np.ix_(known, known)] / np.outer(size, size))
    kept = eigenvalues > SMALLEST_EIGENVALUE * eigenvalues[-1]
    whitened = (vectors[:, kept].T @ (d[known] / size)) / np.sqrt(eigenvalues[kept])
    statistic = float(whitened @ whitened)
    return ChiSquare(statistic, int(kept.sum()), float(chdtrc(int(kept.sum()), statistic)))


def size_probability(vector: ArrayLike, covariance: ArrayLike) -> float:
    """Return the probability that a normal vector with covariance (m, m) is as long as `vector`.

    The squared length is a weighted sum of chi-square variables, approximated by one scaled
    chi-square variable of the same mean and variance (Satterthwaite, Biometrics Bulletin 2, 1946).

    >>> round(size_probability([1.96], [[1.0]]), 3)
    0.05
    """
    v, C = np.asarray(vector, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    mean, square = float(np.trace(C)), float(np.sum(C**2))
    if mean <= 0.0:
        return 0.0 if v.any() else 1.0
    return float(chdtrc(mean**2 / square, float(v @ v) * mean / square))


def probability_text(p: float) -> str:
    """Return a probability with two digits, as text if it is too small for a number."""
    return "below 1e-300" if p < 1e-300 else f"{p:.2g}"
