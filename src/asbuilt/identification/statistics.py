"""Confidence intervals of estimates, and means of paired differences."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from asbuilt.arrays import Array
from asbuilt.errors import UsageError

USUAL_LEVEL = 0.95
"""Level of confidence intervals, by convention."""


def confidence_intervals(
    estimates: Array, std_errors: Array, degrees_of_freedom: Array, level: float
) -> Array:
    """Return `estimate -+ t std_error` (p, 2), t the quantile of Student's distribution.

    Parameters
    ----------
    estimates, std_errors, degrees_of_freedom
        Of each parameter, (p,); infinite degrees of freedom give the normal distribution.
    level
        Probability with which an interval holds the true value.

    Raises
    ------
    UsageError
        If the level is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise UsageError(
            f"the level of a confidence interval lies between 0 and 1, got {level:g}",
            value=level,
            lower=0.0,
            upper=1.0,
        )
    width = stdtrit(degrees_of_freedom, 0.5 + 0.5 * level) * std_errors
    return np.column_stack([estimates - width, estimates + width])


def estimate_mean_error(values: Array) -> float:
    """Return the standard error of the mean of independent values (n,), n at least 2."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def exceeds(excess: Array, standard_errors: float) -> bool:
    """Return whether the mean of paired differences (n,) is beyond so many standard errors."""
    return bool(excess.mean() > standard_errors * estimate_mean_error(excess))
