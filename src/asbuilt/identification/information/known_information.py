"""What an identification knows already, as information about the base parameters.

What a further motion need not tell again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


SINGULAR = 1e-10
"""Variance of a direction, relative to the largest, that only rounding has left.

The covariance holds nothing there.
"""


def determined_directions(result: IdentificationResult) -> tuple[Array, Array, Array]:
    """Return scale (p,), variances (r,) and directions V (p, r) of what a result knows.

    `information = D V diag(1 / variances) V^T D`, D = diag(scale).

    The scale is one over the standard errors, zero for parameters without any: dropped ones, and
    those that the recording does not tell. As many directions are left out as the rank of the
    result falls short, where its covariance is singular there; that of estimates which lean on CAD
    is not.
    """
    covariance = np.array(result.covariance)
    size = np.sqrt(np.diag(covariance))
    told = size > 0
    scale = np.where(told, 1.0 / np.where(told, size, 1.0), 0.0)
    variances, directions = np.linalg.eigh(covariance * np.outer(scale, scale))
    largest, short = max(float(variances[-1]), 0.0), max(0, len(variances) - result.rank)
    kept = variances > largest * len(variances) * np.finfo(float).eps
    if short and variances[short - 1] <= SINGULAR * largest:
        kept[:short] = False
    return scale, variances[kept], directions[:, kept]


def known_information(result: IdentificationResult) -> Array:
    """Return the information matrix (p, p) behind a result.

    The pseudo-inverse of its covariance in scaled columns.

    Directions that the recording does not tell carry no information, nor do dropped parameters,
    which were set and not measured: a further motion may tell them. The standard errors allow for
    correlated residuals, so the information does, too.
    """
    scale, variances, directions = determined_directions(result)
    inverse = (directions / variances) @ directions.T
    information: Array = inverse * np.outer(scale, scale)
    return information
