"""Values by which two results are compared: of one estimator for both, if possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.block_scatter import (
    BlockScatter,
    mean_degrees,
    sum_degrees,
    widening,
)
from asbuilt.validation.comparison.significance import ChiSquare, chi_square, joint_test

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
    scatter: BlockScatter | None = None

    @classmethod
    def own(cls, result: IdentificationResult) -> ComparedValues:
        """Return the values as they were identified."""
        return cls(
            result.estimates,
            result.covariance,
            result.std_errors,
            np.array([parameter.textbook_std_error for parameter in result.parameters]),
            np.array([parameter.determined for parameter in result.parameters]),
            result.dropped,
            result.scatter,
        )

    @classmethod
    def free(cls, result: IdentificationResult) -> ComparedValues:
        """Return the values by weighted least squares alone, or else those identified."""
        found = result.free
        if found is None:
            return cls.own(result)
        return cls(
            found.estimates,
            found.covariance,
            found.std_errors,
            found.textbook_std_errors,
            found.determined,
            np.zeros(len(found.estimates), dtype=np.bool_),
            found.scatter,
        )

    @property
    def degrees_of_freedom(self) -> Array:
        """Degrees of freedom of each standard error, shape (p,); infinite without time blocks."""
        return (
            np.full(len(self.estimates), np.inf)
            if self.scatter is None
            else self.scatter.degrees_of_freedom
        )

    @property
    def textbook_covariance(self) -> Array:
        """Covariance (p, p) with the same correlations and textbook variances."""
        shrink = np.divide(
            self.textbook_std_errors,
            self.std_errors,
            out=np.zeros_like(self.std_errors),
            where=self.std_errors > 0,
        )
        return np.asarray(self.covariance * np.outer(shrink, shrink))

    def test_against(self, values: Array) -> ChiSquare:
        """Test all determined parameters against `values` (p,) at once; NaN are left out."""
        tested = self.determined & ~self.dropped & np.isfinite(values) & (self.std_errors > 0)
        kept = np.flatnonzero(tested)
        difference = self.estimates[kept] - values[kept]
        if self.scatter is None:
            return chi_square(difference, self.covariance[np.ix_(kept, kept)])
        return joint_test(
            difference,
            self.textbook_covariance[np.ix_(kept, kept)],
            self.scatter.moves[:, kept],
            self.scatter.degrees_alone[kept],
            self.scatter.common_variance,
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

    @property
    def variances(self) -> Array:
        """Variances as estimated, not widened for few degrees of freedom, shape (p,)."""
        return np.asarray((self.std_errors / self._wide) ** 2)

    @property
    def narrow_covariance(self) -> Array:
        """Covariance (p, p), not widened."""
        return np.asarray(self.covariance / np.outer(self._wide, self._wide))

    @property
    def bias(self) -> Array:
        """The bias by effects that the model lacks, as far as errors include it, shape (p,)."""
        if self.scatter is None or self.scatter.bias is None:
            return np.zeros(len(self.estimates))
        return self.scatter.bias

    @property
    def narrow_bias(self) -> Array:
        """The bias, not widened, shape (p,)."""
        return np.asarray(self.bias / self._wide)

    @property
    def _wide(self) -> Array:
        return widening(self.degrees_of_freedom)

    def at(self, places: Sequence[int]) -> ComparedValues:
        """Return the values at some places."""
        chosen = np.asarray(places, dtype=np.int64)
        scatter = self.scatter
        if scatter is not None:
            scatter = BlockScatter(
                scatter.moves[:, chosen],
                scatter.degrees_alone[chosen],
                scatter.common_variance,
                None if scatter.bias is None else scatter.bias[chosen],
            )
        return ComparedValues(
            self.estimates[chosen],
            self.covariance[np.ix_(chosen, chosen)],
            self.std_errors[chosen],
            self.textbook_std_errors[chosen],
            self.determined[chosen],
            self.dropped[chosen],
            scatter,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Hold the difference of two independent sets of values of the same p parameters.

    A bias by effects that the model lacks is not independent: both have it, and the difference has
    the difference of both.
    """

    first: ComparedValues
    second: ComparedValues

    @property
    def difference(self) -> Array:
        """Second values minus first ones, shape (p,)."""
        return self.second.estimates - self.first.estimates

    @property
    def degrees_of_freedom(self) -> Array:
        """Of the variances of the difference, shape (p,)."""
        return sum_degrees(
            *((side.variances, side.degrees_of_freedom) for side in (self.first, self.second))
        )

    @property
    def mean_degrees(self) -> float:
        """Harmonic mean of the degrees of freedom."""
        return mean_degrees(self.degrees_of_freedom)

    @property
    def std_errors(self) -> Array:
        """Standard errors, widened for few degrees of freedom, shape (p,)."""
        return np.asarray(np.sqrt(self._variances) * widening(self.degrees_of_freedom))

    @property
    def covariance(self) -> Array:
        """Covariance (p, p), not widened; a bias that both share is no error of the difference."""
        shared = np.outer(self.first.narrow_bias, self.second.narrow_bias)
        # b_1 b_2^T + b_2 b_1^T: what both have in common is no error of their difference.
        together = self.first.narrow_covariance + self.second.narrow_covariance
        return np.asarray(together - shared - shared.T)

    def test(self, tested: Mask) -> ChiSquare:
        """Test the difference of all tested parameters at once."""
        chosen = np.flatnonzero(tested)
        square = np.ix_(chosen, chosen)
        first = self.first
        second = self.second
        d = self.difference[chosen]
        if first.scatter is None or second.scatter is None:
            return chi_square(d, (first.even_covariance + second.even_covariance)[square])
        moves = [
            first.scatter.without_bias,
            second.scatter.without_bias,
            # The difference has the difference of both biases.
            (first.bias - second.bias)[None],
        ]
        alone = sum_degrees(
            (first.variances, first.scatter.degrees_alone),
            (second.variances, second.scatter.degrees_alone),
        )
        # Shares of both in the variance decide what is common.
        share = float(np.mean((first.variances / self._variances)[chosen])) if len(chosen) else 0.0
        common = (
            share**2 * first.scatter.common_variance
            + (1.0 - share) ** 2 * second.scatter.common_variance
        )
        textbook = first.textbook_covariance + second.textbook_covariance
        return joint_test(d, textbook[square], np.vstack(moves)[:, chosen], alone[chosen], common)

    @property
    def _variances(self) -> Array:
        together = self.first.variances + self.second.variances
        return np.asarray(together - 2.0 * self.first.narrow_bias * self.second.narrow_bias)


def select_tested_values(result: IdentificationResult) -> ComparedValues:
    """Return the values by which all parameters are tested at once.

    Those without bounds and regularisation, unless the estimator dropped parameters.
    """
    # Dropped parameters have no free value to be tested.
    return ComparedValues.own(result) if result.dropped.any() else ComparedValues.free(result)


def put_on_equal_terms(
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
