"""Which values of two results are compared: those of one estimator for both, lest the estimators differ where the robot does not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from asbuilt.identification.result import IdentificationResult

Array = NDArray[np.float64]

FREE_METHOD = "wls"
"""The estimator of `FreeValues`."""


@dataclass(frozen=True, slots=True, eq=False)
class ComparedValues:
    """Hold p parameters of a result as they are compared: `estimates`, `covariance` (p, p), `std_errors`, and which are `determined` and `dropped`."""

    estimates: Array
    covariance: Array
    std_errors: Array
    determined: NDArray[np.bool_]
    dropped: NDArray[np.bool_]

    @classmethod
    def own(cls, result: IdentificationResult) -> ComparedValues:
        """Return the values as they were identified."""
        determined = np.array([parameter.determined for parameter in result.parameters])
        return cls(result.estimates, result.covariance, result.std_errors, determined, result.dropped)

    @classmethod
    def free(cls, result: IdentificationResult) -> ComparedValues:
        """Return the values by weighted least squares alone, where the result carries them apart from its own."""
        found = result.free
        if found is None:
            return cls.own(result)
        return cls(found.estimates, found.covariance, found.std_errors, found.determined, np.zeros(len(found.estimates), dtype=np.bool_))


def on_equal_terms(before: IdentificationResult, after: IdentificationResult) -> tuple[ComparedValues, ComparedValues, tuple[str, ...]]:
    """Return the free values of both results where both have them, else their own, and which these are in a sentence, unless they are the same."""
    methods = " and ".join(dict.fromkeys((before.method, after.method)))
    if before.method == after.method == FREE_METHOD:
        return ComparedValues.own(before), ComparedValues.own(after), ()
    if all(result.free is not None or result.method == FREE_METHOD for result in (before, after)):
        told = (
            f"Compared on equal terms, by {FREE_METHOD} of both: the results are by {methods}, and what estimators add (bounds, pull to CAD, less weight to some samples) "
            "would read as change, or hide it. Values are those compared."
        )
        return ComparedValues.free(before), ComparedValues.free(after), (told,)
    told = (
        f"Compared as they were identified, by {methods}: what estimators add (bounds, pull to CAD, less weight to some samples) may read as change, or hide it. "
        "Identify both again to compare on equal terms."
    )
    return ComparedValues.own(before), ComparedValues.own(after), (told,)
