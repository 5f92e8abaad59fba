"""What identified base parameters say of single numbers of a description."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.validation.review.claimed_numbers import ClaimedNumber

WIDEST = 1e3
"""Standard deviation, in its size, of a number that nothing holds."""
UNTOUCHED = 1e-9
"""Part of the variance by which the recording must reduce what is plausible to say anything."""
LOOSE = 100.0
"""Factor by which a number is less held while its aliases are searched."""
ALIKE = 0.5
"""Correlation of two numbers from which one is an alias of the other."""
MOST_ALIASES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Hold k numbers, each estimated with nothing that pulls it to its claimed value.

    `change` (k,) is estimate minus claim, `std_error` (k,) infinite where the recording says
    nothing, `aliases` the places of the numbers that could take its place, `misfit` the root mean
    square of what no plausible numbers explain, in standard errors (Birge, Phys. Rev. 40, 1932).
    """

    change: Array
    std_error: Array
    aliases: tuple[tuple[int, ...], ...]
    misfit: float


def profile_numbers(
    numbers: Sequence[ClaimedNumber], regrouping: Array, difference: Array, covariance: Array
) -> Profile:
    """Estimate each number, the others free within what is plausible.

    With `J` the changes of the base parameters with the numbers and `S` the plausible variances,
    the numbers follow from `(J^T C^-1 J + S^-1) x = J^T C^-1 d`. Without its own row of `S^-1`, a
    number has the estimate `x_j / (1 - P_jj / S_jj)` and the variance `P_jj / (1 - P_jj / S_jj)`,
    `P` the inverse of the matrix (Sherman & Morrison, Annals of Math. Statistics 21, 1950).

    Parameters
    ----------
    numbers
        The numbers, k of them.
    regrouping
        Of the base parameters that are used, shape (p, n_standard).
    difference
        Base parameters as built minus claimed, shape (p,).
    covariance
        Theirs, shape (p, p), positive definite.
    """
    size = np.array([each.size for each in numbers])
    spread = np.minimum(np.array([each.spread for each in numbers]) / size, WIDEST)
    J = regrouping @ np.column_stack([each.column for each in numbers]) * size
    scale = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    whitening = axes / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    A, d = whitening.T @ (J / scale[:, None]), whitening.T @ (difference / scale)
    P = _invert_information(A, spread)
    x = P @ (A.T @ d)
    held = spread < WIDEST
    kept = np.where(held, 1.0 - np.diag(P) / spread**2, 1.0)
    determined = kept > UNTOUCHED
    part = np.where(determined, kept, 1.0)
    variance = np.where(determined, np.diag(P) / part, np.inf)
    variance[~held & (np.diag(P) > 0.25 * WIDEST**2)] = np.inf
    left = d - A @ x
    freedom = max(len(d) - int(np.sum(~held)), 1)
    chi_square = float(left @ left + np.sum((x / spread)[held] ** 2))
    misfit = max(1.0, np.sqrt(chi_square / freedom))
    return Profile(
        np.where(determined, x / part, np.nan) * size,
        np.sqrt(variance) * size * misfit,
        tuple(_find_aliases(P, np.where(held, 1.0 / spread**2, 0.0), j) for j in range(len(size))),
        misfit,
    )


def _invert_information(A: Array, spread: Array) -> Array:
    """Return `(A^T A + diag(spread)^-2)^-1`, by the singular values of `A diag(spread)`."""
    _, s, Vt = np.linalg.svd(A * spread, full_matrices=True)
    left = np.ones(len(spread))
    left[: len(s)] = 1.0 / (1.0 + s**2)
    return np.asarray((Vt.T @ (left[:, None] * Vt)) * np.outer(spread, spread))


def _find_aliases(P: Array, weight: Array, j: int) -> tuple[int, ...]:
    """Return the numbers most correlated with number j where it is held `LOOSE` times less."""
    released = weight[j] * (1.0 - LOOSE**-2)
    kept = 1.0 - released * P[j, j]
    variance = np.diag(P) + P[j] ** 2 * released / kept
    correlation = np.abs(P[j] / kept) / np.sqrt(np.maximum(variance * P[j, j] / kept, 1e-300))
    correlation[j] = 0.0
    return tuple(int(k) for k in np.argsort(-correlation)[:MOST_ALIASES] if correlation[k] >= ALIKE)
