"""Scalar criteria of the information matrix, with their gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve

from asbuilt.arrays import Array
from asbuilt.errors import UsageError

SMOOTHNESS = 16
"""Exponent of the norm that approximates the extreme eigenvalue in e and condition."""


class Criterion(ABC):
    """Rate an information matrix M (p, p) of scaled parameters; larger is better."""

    key: ClassVar[str]

    @abstractmethod
    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and its derivative with respect to M, symmetric (p, p).

        Minus infinity where M is not positive definite.
        """

    def value(self, information: Array) -> float:
        """Return the value alone."""
        return self.value_and_gradient(information)[0]


@dataclass(frozen=True)
class DOptimality(Criterion):
    """Maximise `log det M`: the smallest confidence ellipsoid, whatever the units."""

    key = "d"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return `log det M` and `M^-1`."""
        factor = _try_cholesky(information)
        if factor is None:
            return -np.inf, np.zeros_like(information)
        return 2.0 * float(np.log(np.diag(factor)).sum()), _invert_factored(factor)


@dataclass(frozen=True, eq=False)
class AOptimality(Criterion):
    """Maximise `-p log(tr(A M^-1) / p)`: the smallest mean variance of what A weighs.

    Without `weight` A is the identity, and the scaled parameters matter alike. With A (p, p) the
    mean of `Y^T Y` over the states of a motion it is the variance of the torque predicted there.

    Source: Atkinson, Donev & Tobias (2007), sections 10.2 and 10.6 (A-, V-optimality).
    """

    weight: Array | None = None
    key = "a"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and `p M^-1 A M^-1 / tr(A M^-1)`."""
        factor = _try_cholesky(information)
        if factor is None:
            return -np.inf, np.zeros_like(information)
        inverse = _invert_factored(factor)
        p = len(information)
        weighted = inverse if self.weight is None else self.weight @ inverse
        trace = float(np.trace(weighted))
        return -p * np.log(trace / p), p * (inverse @ weighted) / trace


@dataclass(frozen=True)
class EOptimality(Criterion):
    """Maximise p times the log of a smooth smallest eigenvalue, `(sum_i l_i^-s)^(-1/s)`, s = 16.

    No direction is left poorly determined.
    """

    key = "e"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and its gradient, from the eigenvalues of M."""
        eigenvalues, vectors = np.linalg.eigh(information)
        if eigenvalues[0] <= 0:
            return -np.inf, np.zeros_like(information)
        value, slope = _smooth_log_smallest(eigenvalues)
        p = len(information)
        return p * value, p * (vectors * slope) @ vectors.T


@dataclass(frozen=True)
class ConditionNumber(Criterion):
    """Minimise the condition number of the observation matrix.

    Maximise `-p/2 log` of a smooth `l_max / l_min` of M.
    """

    key = "condition"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and its gradient, from the eigenvalues of M."""
        eigenvalues, vectors = np.linalg.eigh(information)
        if eigenvalues[0] <= 0:
            return -np.inf, np.zeros_like(information)
        low, low_slope = _smooth_log_smallest(eigenvalues)
        high, high_slope = _smooth_log_smallest(1.0 / eigenvalues)
        slope = low_slope - high_slope / eigenvalues**2
        p = len(information)
        return p / 2 * (low + high), p / 2 * (vectors * slope) @ vectors.T


@dataclass(frozen=True)
class FocusedDOptimality(Criterion):
    """Maximise `log det` of the information on chosen parameters, all others being unknown too.

    `log det M - log det M_rest` (D_s).

    `chosen` are positions among the base parameters. Source: Atkinson, Donev & Tobias (2007),
    section 10.3.
    """

    chosen: tuple[int, ...]
    key = "d"

    def value_and_gradient(self, information: Array) -> tuple[float, Array]:
        """Return the value and `M^-1` less the inverse of the block of the others."""
        rest = np.setdiff1d(np.arange(len(information)), self.chosen)
        value, gradient = DOptimality().value_and_gradient(information)
        if not np.isfinite(value) or not rest.size:
            return value, gradient
        others, inverse = DOptimality().value_and_gradient(information[np.ix_(rest, rest)])
        gradient = gradient.copy()
        gradient[np.ix_(rest, rest)] -= inverse
        return value - others, gradient


CRITERIA: dict[str, type[Criterion]] = {
    kind.key: kind for kind in (DOptimality, AOptimality, EOptimality, ConditionNumber)
}
"""The criteria by key; `FocusedDOptimality` is d with a focus."""


def select_criterion(key: str, focus: ArrayLike | None = None) -> Criterion:
    """Return the criterion of this name, d with a focus as D_s.

    Raises UsageError for unknown names and for a focus with another criterion.
    """
    if key not in CRITERIA:
        raise UsageError(f"unknown criterion {key!r}; available: {', '.join(CRITERIA)}")
    if focus is None:
        return CRITERIA[key]()
    if key != "d":
        raise UsageError(f"a focus goes with the criterion d (it becomes D_s), not with {key!r}")
    return FocusedDOptimality(tuple(int(position) for position in np.asarray(focus)))


def _try_cholesky(matrix: Array) -> Array | None:
    try:
        factor = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return factor if np.all(np.isfinite(factor)) else None


def _invert_factored(factor: Array) -> Array:
    return np.asarray(cho_solve((factor, True), np.eye(len(factor))))


def _smooth_log_smallest(values: Array) -> tuple[float, Array]:
    smallest = values.min()
    powers = (smallest / values) ** SMOOTHNESS
    total = powers.sum()
    return float(np.log(smallest) - np.log(total) / SMOOTHNESS), powers / total / values
