"""What a symmetric matrix determines: solutions, inverse and roots in columns of unit size."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array, Mask

SMALLEST = 1e-12
"""Eigenvalue of the scaled matrix, relative to the largest, from which on a direction counts.

Products of columns that are exact to eps have eigenvalues exact to some p eps, 1e-14 for the
largest robots; filters, sums over blocks and inversions lose two more digits. Columns behind the
matrix are then told apart down to one millionth of their length. A column shorter than this part of
the longest one is rounding too: the cosine of a right angle leaves 6e-17 of it.
"""
OPEN = 1e-6
"""Squared part of a parameter in directions that do not count, above which it is undetermined: one
thousandth of its length, ten times what SMALLEST lets directions turn by."""


@dataclass(frozen=True, eq=False)
class Scaled:
    """Decompose a symmetric positive semidefinite matrix A (p, p), information or covariance.

    With D = diag(size), the square roots of the diagonal, `A = D V diag(values) V^T D` in the
    directions that count. Units of the parameters change none of them, which makes one tolerance
    possible (van der Sluis, Numerische Mathematik 14, 1969).

    >>> own = Scaled(np.array([[4.0, 0.0, 2e3], [0.0, 0.0, 0.0], [2e3, 0.0, 1e6]]))
    >>> own.rank, own.determined.tolist()
    (1, [False, False, False])
    >>> Scaled(np.diag([4.0, 1e8])).solve(np.array([2.0, 1e8])).tolist()
    [0.5, 1.0]
    """

    matrix: Array

    @cached_property
    def present(self) -> Mask:
        """Which parameters have any column, (p,)."""
        squares = np.diag(self.matrix)
        there: Mask = squares > SMALLEST**2 * squares.max(initial=0.0)
        return there

    @cached_property
    def size(self) -> Array:
        """Lengths of the columns (p,), 1 where there is none."""
        return np.sqrt(np.where(self.present, np.diag(self.matrix), 1.0))

    @cached_property
    def _spectrum(self) -> tuple[Array, Array, Mask]:
        """Eigenvalues, axes and which of them count, of the matrix with unit diagonal."""
        scaled = self.matrix / np.outer(self.size, self.size)
        # Zero, so that absent parameters have no rounding of others in any direction.
        values, axes = np.linalg.eigh(scaled * np.outer(self.present, self.present))
        axes = axes * self.present[:, None]
        return values, axes, values > SMALLEST * max(values.max(initial=0.0), 0.0)

    @property
    def values(self) -> Array:
        """Eigenvalues of the directions that count (r,), in ascending order."""
        values, _, counts = self._spectrum
        return np.asarray(values[counts])

    @property
    def axes(self) -> Array:
        """Directions that count, V (p, r)."""
        _, axes, counts = self._spectrum
        return np.asarray(axes[:, counts])

    @property
    def rank(self) -> int:
        """Number of directions that count."""
        return int(np.count_nonzero(self._spectrum[2]))

    @property
    def condition(self) -> float:
        """Condition number of the scaled matrix; infinite if some direction does not count."""
        values = self._spectrum[0]
        full = self.rank == len(values) > 0
        return float(values[-1] / values[0]) if full else np.inf

    @property
    def determined(self) -> Mask:
        """Which parameters lie in directions that count, (p,)."""
        _, axes, counts = self._spectrum
        outside = (axes[:, ~counts] ** 2).sum(axis=1)
        return np.asarray(self.present & (outside <= OPEN))

    @cached_property
    def root(self) -> Array:
        """R (r, p) with `R^T R = A`."""
        return np.asarray((self.axes * np.sqrt(self.values)).T * self.size)

    @cached_property
    def inverse_root(self) -> Array:
        """L (p, r) with `L L^T = A^+`, in directions that count."""
        return np.asarray(self.axes / np.sqrt(self.values) / self.size[:, None])

    @property
    def pseudo_inverse(self) -> Array:
        """The inverse (p, p) in the directions that count."""
        root = self.inverse_root
        return np.asarray(root @ root.T)

    @property
    def inverse_diagonal(self) -> Array:
        """Diagonal of the pseudo-inverse, (p,): variances, if the matrix is information."""
        return np.asarray(np.sum(self.inverse_root**2, axis=1))

    def solve(self, right: Array) -> Array:
        """Return x with `A x = right`, (p,) or (p, m), without directions that do not count."""
        return np.asarray(self.inverse_root @ (self.inverse_root.T @ right))

    def whiten(self, x: Array) -> Array:
        """Return x (p,) or (p, m) of covariance A in coordinates (r, ...) of covariance 1."""
        return np.asarray(self.inverse_root.T @ x)

    def square(self, x: Array) -> float:
        """Return `x^T A^+ x` of a vector (p,), the squared distance in standard errors."""
        white = self.whiten(x)
        return float(white @ white)

    def raised(self, least: float = SMALLEST) -> Scaled:
        """Return the matrix with no eigenvalue below this part of the largest: all p count.

        A covariance that knows a direction better than that does so by rounding, or by a belief
        that nothing measured.
        """
        values, axes, _ = self._spectrum
        high = np.maximum(values, least * max(values.max(initial=0.0), 0.0))
        found = Scaled((axes * high) @ axes.T * np.outer(self.size, self.size))
        # As they are: another decomposition would take the size of the raised diagonal.
        vars(found).update(
            present=np.ones(len(values), dtype=np.bool_),
            size=self.size,
            _spectrum=(high, axes, high > 0.0),
        )
        return found


def find_column_space(columns: Array) -> Array:
    """Return an orthonormal basis (N, r) of what columns (N, p) span, by the same tolerance.

    >>> find_column_space(np.array([[1.0, 2.0], [1.0, 2.0]])).shape
    (2, 1)
    """
    length = np.linalg.norm(columns, axis=0)
    present = length > SMALLEST * length.max(initial=0.0)
    basis, values, _ = np.linalg.svd(columns[:, present] / length[present], full_matrices=False)
    return np.asarray(basis[:, values > np.sqrt(SMALLEST) * values.max(initial=0.0)])
