"""Values by which two results are compared: of one estimator for both, if possible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Mask

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


FREE_METHOD = "wls"
"""The estimator of `FreeValues`."""


@dataclass(frozen=True, slots=True, eq=False)
class ComparedValues:
    """Hold p parameters of a result as they are compared, with covariance (p, p) and errors."""

    estimates: Array
    covariance: Array
    std_errors: Array
    textbook_std_errors: Array
    determined: Mask
    dropped: Mask

    @classmethod
    def own(cls, result: IdentificationResult) -> ComparedValues:
        """Return the values as they were identified."""
        determined = np.array([parameter.determined for parameter in result.parameters])
        textbook = np.array([parameter.textbook_std_error for parameter in result.parameters])
        return cls(
            result.estimates,
            result.covariance,
            result.std_errors,
            textbook,
            determined,
            result.dropped,
        )

    @classmethod
    def free(cls, result: IdentificationResult) -> ComparedValues:
        """Return the values by weighted least squares alone, or else those identified."""
        found = result.free
        if found is None:
            return cls.own(result)
        none = np.zeros(len(found.estimates), dtype=np.bool_)
        return cls(
            found.estimates,
            found.covariance,
            found.std_errors,
            found.textbook_std_errors,
            found.determined,
            none,
        )

    @property
    def even_covariance(self) -> Array:
        """The textbook covariance (p, p), scaled by the mean growth of the variances.

        For tests of many parameters at once. Time blocks give the growth of each variance but no
        correlation; scaling each by its own would distort the variance of sums of parameters.
        """
        usable = (self.std_errors > 0) & (self.textbook_std_errors > 0)
        growth = np.divide(
            self.std_errors,
            self.textbook_std_errors,
            out=np.ones_like(self.std_errors),
            where=usable,
        )
        even = float(np.sqrt(np.mean(growth[usable] ** 2))) if usable.any() else 1.0
        shrink = even / growth
        return np.asarray(self.covariance * np.outer(shrink, shrink))


def on_equal_terms(
    before: IdentificationResult, after: IdentificationResult
) -> tuple[ComparedValues, ComparedValues, tuple[str, ...]]:
    """Return the values of both results to compare, and a sentence if their estimators matter.

    These are the free values if both results have them, else those identified.
    """
    methods = " and ".join(dict.fromkeys((before.method, after.method)))
    if before.method == after.method == FREE_METHOD:
        return ComparedValues.own(before), ComparedValues.own(after), ()
    if all(result.free is not None or result.method == FREE_METHOD for result in (before, after)):
        note = (
            f"Compared by {FREE_METHOD} of both, since the results are by {methods}: bounds,"
            " regularisation and weights of an estimator could appear as a change, or hide one."
        )
        return ComparedValues.free(before), ComparedValues.free(after), (note,)
    note = (
        f"Compared as identified, by {methods}: bounds, regularisation and weights of an estimator"
        " may appear as a change, or hide one. Identify both again to compare by one estimator."
    )
    return ComparedValues.own(before), ComparedValues.own(after), (note,)
