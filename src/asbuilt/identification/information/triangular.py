"""Rows of any number reduced to a triangle by Householder QR, a cache full at a time."""

from __future__ import annotations

import base64

import numpy as np
from scipy.linalg import lapack

from asbuilt.arrays import Array, Indices

ROWS_AT_ONCE = 1024
"""Rows reduced by one QR: with some 50 columns they fit the cache."""


def triangular_factor(rows: Array) -> Array:
    """Return the upper triangular R (p, p), diagonal >= 0, with `R^T R = rows^T rows`."""
    return reduce_columns(np.ascontiguousarray(rows.T), len(rows))


def factor_distance(root: Array, beta: Array) -> Array:
    """Return the factor (p + 1, p + 1) of the distance `|R (x - beta)|^2` with the root R."""
    rows = np.column_stack([root, root @ beta])
    return triangular_factor(np.vstack([rows, np.zeros((1, len(beta) + 1))]))


def reduce_columns(columns: Array, capacity: int = ROWS_AT_ONCE) -> Array:
    """Return the factor of rows given as columns (p, m), at most `capacity` at a time."""
    growing = GrowingFactor(len(columns), min(capacity, columns.shape[1]))
    growing.append(columns)
    return growing.factor()


def widen_factor(factor: Array, support: Indices, p: int) -> Array:
    """Return a factor of the columns `support` and the torque with all p columns and the torque."""
    wide = np.zeros((len(factor), p + 1))
    wide[:, np.append(support, p)] = factor
    return wide


def pack_triangle(matrix: Array) -> str:
    """Return the upper triangle of a matrix by rows, as base64 of little-endian doubles."""
    return base64.b64encode(matrix[np.triu_indices(len(matrix))].astype("<f8").tobytes()).decode(
        "ascii"
    )


def unpack_triangle(text: str) -> Array:
    """Return the upper triangular matrix (p, p) of `pack_triangle`.

    Raises ValueError if the text does not hold p (p + 1) / 2 numbers.
    """
    entries = np.frombuffer(base64.b64decode(text), dtype="<f8")
    p = int(np.sqrt(2 * len(entries)))
    triangle = np.zeros((p, p))
    triangle[np.triu_indices(p)] = entries
    return triangle


def unpack_symmetric(text: str) -> Array:
    """Return the symmetric matrix (p, p) whose upper triangle was packed."""
    upper = unpack_triangle(text)
    return upper + np.triu(upper, 1).T


class GrowingFactor:
    """Reduce a growing number of rows with p columns to their factor, `capacity` at a time."""

    def __init__(self, p: int, capacity: int = ROWS_AT_ONCE) -> None:
        self._p = p
        self._rows = np.zeros((p, p + max(capacity, 1)))
        self._filled = p

    def append(self, columns: Array, support: Indices | None = None) -> None:
        """Add rows given as columns (p, m): samples innermost.

        With `support` they are these columns (s, m) only, the others zero.
        """
        start, places = 0, slice(None) if support is None else support
        while start < columns.shape[1]:
            if self._filled == self._rows.shape[1]:
                self._reduce()
            taken = min(columns.shape[1] - start, self._rows.shape[1] - self._filled)
            added = self._rows[:, self._filled : self._filled + taken]
            if support is not None:
                added[...] = 0.0
            added[places] = columns[:, start : start + taken]
            self._filled += taken
            start += taken

    def factor(self) -> Array:
        """Return R (p, p) of everything added so far."""
        self._reduce()
        r = self._rows[:, : self._p].T.copy()
        return np.asarray(r * np.where(np.diag(r) < 0, -1.0, 1.0)[:, None])

    def _reduce(self) -> None:
        if self._filled > self._p:
            full = self._filled == self._rows.shape[1]
            rows = self._rows.T if full else self._rows[:, : self._filled].T.copy(order="F")
            # Columns that one block reflector takes. The panels of `geqrf` are as wide as these
            # matrices, so it works by vectors: with 30 to 60 columns `geqrt` takes half of its
            # time.
            lapack.dgeqrt(min(8, self._p), rows, overwrite_a=True)
            self._rows[:, : self._p] = np.tril(rows[: self._p].T)
            self._filled = self._p
