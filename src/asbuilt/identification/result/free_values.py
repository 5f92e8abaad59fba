"""Weighted least squares alone, by which results of different estimators are compared."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.codec import store_as
from asbuilt.errors import ResultError
from asbuilt.identification.errors.block_scatter import BlockScatter
from asbuilt.identification.errors.uncertainty import estimate_block_uncertainty
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import pack_triangle, unpack_symmetric


@dataclass(frozen=True, slots=True, eq=False)
class FreeValues:
    """Hold the p base parameters by weighted least squares without bounds or regularisation.

    `estimates` (p,), their block-robust `covariance` (p, p), the `textbook_std_errors` (p,) that
    were widened for it, which are `determined` (p,), and the `scatter` of the time blocks.
    """

    estimates: Array
    covariance: Array = field(metadata=store_as(encode=pack_triangle, decode=unpack_symmetric))
    textbook_std_errors: Array
    determined: NDArray[np.bool_]
    scatter: BlockScatter | None = None

    def __post_init__(self) -> None:
        p = len(self.estimates)
        shapes = [self.covariance.shape, self.textbook_std_errors.shape, self.determined.shape]
        if shapes != [(p, p), (p,), (p,)]:
            raise ResultError(f"{p} free values need as many errors, got {shapes}; identify again")
        for values in (self.estimates, self.covariance, self.textbook_std_errors, self.determined):
            values.setflags(write=False)

    @property
    def std_errors(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))


def fit_free_values(
    information: SquareRootInformation,
    toward: ArrayLike,
    beside: Array | None = None,
    bias: Array | None = None,
) -> FreeValues:
    """Fit by `wls` with errors from time blocks.

    Parameters
    ----------
    information
        What the recordings say.
    toward
        Values (p,) of directions that the recordings leave undetermined; NaN counts as zero.
    beside
        Covariance (p, p) that other things add, such as fitted nonlinear parameters.
    bias
        Bias (p,) whose square is part of it.
    """
    fitted = fit_least_squares(information, weights="joint", prior=toward)
    uncertainty = estimate_block_uncertainty(information, fitted)
    covariance, scatter = uncertainty.covariance, uncertainty.scatter
    if beside is not None:
        covariance = covariance + beside
        scatter = None if scatter is None else scatter.beside(beside, bias)
    return FreeValues(
        fitted.beta,
        0.5 * (covariance + covariance.T),
        fitted.std_errors,
        fitted.determined,
        scatter,
    )
