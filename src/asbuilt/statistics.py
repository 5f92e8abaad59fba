"""Confidence intervals of estimates, errors of means, and the jackknife."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from asbuilt.arrays import Array
from asbuilt.errors import UsageError
from asbuilt.findings import Cure

USUAL_ALPHA = 0.05
"""Probability outside a confidence interval, by convention."""
LARGEST_ALPHA = 0.5
"""What is larger is meant as the probability inside: nobody asks for an interval that is likelier
wrong than right."""


def confidence_intervals(
    estimates: Array, std_errors: Array, degrees_of_freedom: Array, alpha: float
) -> Array:
    """Return `estimate -+ t std_error` (p, 2), t the quantile of Student's distribution.

    Parameters
    ----------
    estimates, std_errors, degrees_of_freedom
        Of each parameter, (p,); infinite degrees of freedom give the normal distribution.
    alpha
        Probability with which an interval does not hold the true value, as in statsmodels.

    Raises
    ------
    UsageError
        If alpha is not between 0 and 0.5.
    """
    if not 0.0 < alpha < LARGEST_ALPHA:
        raise UsageError(
            "alpha is the probability outside a confidence interval, between 0 and"
            f" {LARGEST_ALPHA:g}, got {alpha:g}",
            cure=Cure("write alpha=0.05 for an interval of 95 %"),
            value=alpha,
            lower=0.0,
            upper=LARGEST_ALPHA,
        )
    width = stdtrit(degrees_of_freedom, 1.0 - 0.5 * alpha) * std_errors
    return np.column_stack([estimates - width, estimates + width])


def estimate_mean_error(values: Array) -> float:
    """Return the standard error of the mean of independent values (n,), n at least 2."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def jackknife_covariance(without: Array) -> Array:
    """Return the covariance (p, p) of an estimate by what it is without each of m blocks, (m, p).

    It is `(m - 1) / m` times the sum of squares about the mean, and allows for correlation within
    blocks (Miller, Biometrika 61, 1974).

    Of a mean it is the square of the usual standard error:

    >>> x = np.array([1.0, 2.0, 4.0, 9.0])
    >>> without = np.array([[np.delete(x, k).mean()] for k in range(4)])
    >>> bool(np.isclose(jackknife_covariance(without)[0, 0], estimate_mean_error(x) ** 2))
    True
    """
    apart = without - without.mean(axis=0)
    return np.asarray((len(without) - 1) / len(without) * apart.T @ apart)


def exceeds(excess: Array, standard_errors: float) -> bool:
    """Return whether the mean of paired differences (n,) is beyond so many standard errors."""
    return bool(excess.mean() > standard_errors * estimate_mean_error(excess))
