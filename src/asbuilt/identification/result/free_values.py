"""What the recordings say by themselves.

Weighted least squares without bounds or pull to CAD, so that results of whatever estimators compare
on equal terms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.errors import ResultError
from asbuilt.identification.errors.uncertainty import block_uncertainty
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import packed_triangle, unpacked_triangle


@dataclass(frozen=True, slots=True, eq=False)
class FreeValues:
    """Hold the p base parameters by weighted least squares alone.

    `estimates` (p,), their block-robust `covariance` (p, p), the `textbook_std_errors` (p,) that
    were widened for it, and which are `determined` (p,).
    """

    estimates: Array
    covariance: Array
    textbook_std_errors: Array
    determined: NDArray[np.bool_]

    def __post_init__(self) -> None:
        p = len(self.estimates)
        if (
            self.covariance.shape != (p, p)
            or self.textbook_std_errors.shape != (p,)
            or self.determined.shape != (p,)
        ):
            raise ResultError(
                f"{p} free values need as many errors, got {self.covariance.shape},"
                f" {self.textbook_std_errors.shape} and {self.determined.shape}; identify again"
            )
        for values in (self.estimates, self.covariance, self.textbook_std_errors, self.determined):
            values.setflags(write=False)

    @property
    def std_errors(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def as_dict(self) -> dict[str, Any]:
        """Return numbers and lists, ready for JSON.

        The covariance is its upper triangle, row by row, as base64 of little-endian doubles.
        """
        return {
            "estimates": self.estimates.tolist(),
            "covariance": packed_triangle(self.covariance),
            "textbook_std_errors": self.textbook_std_errors.tolist(),
            "determined": self.determined.tolist(),
        }

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> FreeValues:
        """Rebuild from `as_dict`; raises `ResultError` where that is damaged."""
        try:
            estimates = np.array(fields["estimates"], dtype=np.float64)
            upper = unpacked_triangle(fields["covariance"], len(estimates))
            textbook = np.array(fields["textbook_std_errors"], dtype=np.float64)
            return cls(
                estimates,
                upper + np.triu(upper, 1).T,
                textbook,
                np.array(fields["determined"], dtype=np.bool_),
            )
        except (KeyError, TypeError, ValueError) as problem:
            if isinstance(problem, ResultError):
                raise
            raise ResultError(
                f"the free values are damaged ({type(problem).__name__} {problem}); identify again"
            ) from problem


def free_values(
    information: SquareRootInformation, toward: ArrayLike, beside: Array | None = None
) -> FreeValues:
    """Fit by `wls` with errors from time blocks.

    What the recordings leave open lies `toward` (p,), NaN counting as zero, and is not determined.

    `beside` (p, p) is the covariance that fitted nonlinear parameters of drive terms add.
    """
    fitted = fit_least_squares(information, weights="joint", prior=toward)
    covariance = block_uncertainty(information, fitted).covariance + (
        0.0 if beside is None else beside
    )
    return FreeValues(
        fitted.beta, 0.5 * (covariance + covariance.T), fitted.std_errors, fitted.determined
    )
