"""Which values of two results are compared.

Those of one estimator for both, lest the estimators differ where the robot does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


FREE_METHOD = "wls"
"""The estimator of `FreeValues`."""


@dataclass(frozen=True, slots=True, eq=False)
class ComparedValues:
    """Hold p parameters of a result as they are compared.

    `estimates`, `covariance` (p, p), `std_errors` and the textbook's, and which are `determined`
    and `dropped`.
    """

    estimates: Array
    covariance: Array
    std_errors: Array
    textbook_std_errors: Array
    determined: NDArray[np.bool_]
    dropped: NDArray[np.bool_]

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
        """Return the values by weighted least squares alone, where the result carries them apart
        from its own.
        """
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
        """The textbook's covariance, all variances grown by the mean of how much each did, shape
        (p, p): for tests of many parameters at once.

        Time blocks tell how each variance grew beyond the textbook's, but no correlation; sums of
        parameters that only together are known well would, each grown by its own, seem known where
        they are not, and not where they are.
        """
        told = (self.std_errors > 0) & (self.textbook_std_errors > 0)
        growth = np.divide(
            self.std_errors, self.textbook_std_errors, out=np.ones_like(self.std_errors), where=told
        )
        even = float(np.sqrt(np.mean(growth[told] ** 2))) if told.any() else 1.0
        shrink = even / growth
        return np.asarray(self.covariance * np.outer(shrink, shrink))


def on_equal_terms(
    before: IdentificationResult, after: IdentificationResult
) -> tuple[ComparedValues, ComparedValues, tuple[str, ...]]:
    """Return the free values of both results where both have them, else their own, and which these
    are in a sentence, unless they are the same.
    """
    methods = " and ".join(dict.fromkeys((before.method, after.method)))
    if before.method == after.method == FREE_METHOD:
        return ComparedValues.own(before), ComparedValues.own(after), ()
    if all(result.free is not None or result.method == FREE_METHOD for result in (before, after)):
        told = (
            f"Compared on equal terms, by {FREE_METHOD} of both: the results are by {methods}, and"
            " what estimators add (bounds, pull to CAD, less weight to some samples) would read as"
            " change, or hide it. Values are those compared."
        )
        return ComparedValues.free(before), ComparedValues.free(after), (told,)
    told = (
        f"Compared as they were identified, by {methods}: what estimators add (bounds, pull to CAD,"
        " less weight to some samples) may read as change, or hide it. Identify both again to"
        " compare on equal terms."
    )
    return ComparedValues.own(before), ComparedValues.own(after), (told,)
