"""Information about base parameters behind a result, for the design of further motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


def find_determined_directions(
    result: IdentificationResult, *, with_bias: bool = True
) -> tuple[Array, Array, Array]:
    """Return scale (p,), variances (r,) and directions V (p, r) of the information of a result.

    `information = D V diag(1 / variances) V^T D`, D = diag(scale). The scale is one over the
    standard errors, zero for dropped and undetermined parameters. Directions beyond the rank of the
    result are left out if its covariance is singular there; the covariance of estimates
    regularised toward CAD is not. Without bias the covariance counts scatter alone.
    """
    covariance = np.array(result.covariance)
    if result.bias is not None and not with_bias:
        covariance -= result.bias
    size = np.sqrt(np.diag(covariance))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    variances, directions = np.linalg.eigh(covariance * np.outer(scale, scale))
    largest, short = max(float(variances[-1]), 0.0), max(0, len(variances) - result.rank)
    kept = variances > largest * len(variances) * np.finfo(float).eps
    # Variance of a direction, relative to the largest, that is rounding.
    if short and variances[short - 1] <= 1e-10 * largest:
        kept[:short] = False
    return scale, variances[kept], directions[:, kept]


def known_information(result: IdentificationResult) -> Array:
    """Return the information matrix (p, p) of a result: the pseudo-inverse of its covariance.

    Undetermined directions and dropped parameters carry no information. The information allows for
    correlated residuals, since the standard errors do.
    """
    scale, variances, directions = find_determined_directions(result)
    inverse = (directions / variances) @ directions.T
    information: Array = inverse * np.outer(scale, scale)
    return information
