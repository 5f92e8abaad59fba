"""Triangular factors of any number of rows by Householder QR, and least squares from them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, qr

from asbuilt.arrays import Array, Indices

ROWS_AT_ONCE = 1024
"""Rows reduced by one QR: with some 50 columns they fit the cache."""
REFLECTORS_AT_ONCE = 16
"""Columns of a triangle that one block reflector takes: of 8 to 32 none is faster."""
FEW_COLUMNS = 100
"""Columns up to which one factor of all rows takes less time than many small ones do."""
NEGLIGIBLE_COEFFICIENT = 1e-6
"""Coefficient of a direction, in columns of length 1, that is rounding."""


def triangular_factor(rows: Array) -> Array:
    """Return the upper triangular R (p, p), diagonal >= 0, with `R^T R = rows^T rows`."""
    return reduce_columns(np.ascontiguousarray(rows.T), len(rows))


def factor_distance(root: Array, beta: Array) -> Array:
    """Return the factor (p + 1, p + 1) of the distance `|R (x - beta)|^2` with the root R."""
    return triangular_factor(
        # A zero row makes the stack square: the distance has no residual of its own.
        np.vstack([np.column_stack([root, root @ beta]), np.zeros((1, len(beta) + 1))])
    )


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


def join_factors(one: Array, other: Array) -> Array:
    """Return the triangular factor of the rows of two triangular factors (p, p) together.

    It takes a fifth of what a factor of their stack does, which has no zeros to rely on.
    """
    return _make_diagonal_positive(_absorb(np.array(one, order="F"), other))


def stack_factors(parts: Sequence[tuple[Indices, Array]], p: int) -> Array:
    """Return the factor (p + 1, p + 1) of rows that have some of p columns each, and the torque.

    A part are ascending columns (s,) and rows (m, s + 1), triangular or not. From the last on, each
    is joined with those that share columns with it, in their columns alone: a joint has the columns
    of all joints behind it, so that factors grow along each limb and meet where the limbs do.
    """
    if p <= FEW_COLUMNS:
        growing = GrowingFactor(p + 1, sum(len(rows) for _, rows in parts))
        for columns, rows in parts:
            # Rows go in as columns: samples innermost.
            growing.append(rows.T, np.append(columns, p))
        return growing.factor()
    apart: dict[int, tuple[Indices, Array]] = {}
    # The number of the part that a column is in so far.
    owner = np.full(p, -1)
    for number, (columns, rows) in reversed(list(enumerate(parts))):
        met = [apart.pop(other) for other in np.unique(owner[columns]).tolist() if other >= 0]
        apart[number] = _join_parts([(columns, rows), *met])
        owner[apart[number][0]] = number
    every = np.arange(p)
    return _make_diagonal_positive(_join_parts([(every, np.empty((0, p + 1))), *apart.values()])[1])


def _join_parts(parts: Sequence[tuple[Indices, Array]]) -> tuple[Indices, Array]:
    """Return the columns (s,) of all parts and their factor (s + 1, s + 1)."""
    columns = np.unique(np.concatenate([own for own, _ in parts]))
    n = len(columns) + 1
    factor = np.zeros((n, n), order="F")
    for own, rows in parts:
        places = np.append(np.searchsorted(columns, own), n - 1)
        if len(rows) == len(places) and not np.any(factor) and not np.any(np.tril(rows, -1)):
            # A triangle stays one in more columns, each row at its own.
            factor[np.ix_(places, places)] = rows
        elif len(rows):
            first = int(places[0])
            further = np.zeros((len(rows), n - first), order="F")
            further[:, places - first] = rows
            # Rows change nothing in front of their own columns.
            behind = np.asfortranarray(factor[first:, first:])
            factor[first:, first:] = _absorb(behind, further)
    return columns, factor


def _absorb(factor: Array, rows: Array) -> Array:
    """Return the factor (n, n) of an upper triangular one, which is lost, and rows (m, n)."""
    n = len(factor)
    # Rows with zeros below the diagonal take a third of the work, and leave them zero.
    triangular = len(rows) <= n and not np.any(np.tril(rows, -1))
    known, _, _, _ = lapack.dtpqrt(
        len(rows) if triangular else 0,
        min(REFLECTORS_AT_ONCE, n),
        factor,
        np.asfortranarray(rows),
        overwrite_a=True,
    )
    return np.asarray(known)


def _make_diagonal_positive(factor: Array) -> Array:
    # Householder's signs are arbitrary: the diagonal is made positive, so that factors compare.
    return np.asarray(factor * np.where(np.diag(factor) < 0, -1.0, 1.0)[:, None])


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
    # p < sqrt(p (p + 1)) < p + 1, so that truncation gives p.
    p = int(np.sqrt(2 * len(entries)))
    triangle = np.zeros((p, p))
    triangle[np.triu_indices(p)] = entries
    return triangle


def unpack_symmetric(text: str) -> Array:
    """Return the symmetric matrix (p, p) whose upper triangle was packed."""
    upper = unpack_triangle(text)
    return upper + np.triu(upper, 1).T


def stack_blocks(blocks: Sequence[Array]) -> Array:
    """Return the rows (m, p) of blocks as one array (B, m, p), zeros below shorter ones."""
    stacked = np.zeros((len(blocks), max(map(len, blocks)), blocks[0].shape[1]))
    for place, rows in zip(stacked, blocks, strict=True):
        place[: len(rows)] = rows
    return stacked


def is_triangular(rows: Array) -> bool:
    """Return whether rows (m, p) are an upper triangular factor (p, p) already."""
    return len(rows) == rows.shape[1] and not np.any(np.tril(rows, -1))


def shorten_rows(rows: Array) -> Array:
    """Return rows (m, p), or their triangular factor if that has fewer."""
    return triangular_factor(rows) if len(rows) > rows.shape[1] else rows


def shorten_columns(columns: Array) -> Array:
    """Return rows given as columns (p, m) as rows, or their triangular factor if it has fewer."""
    return reduce_columns(columns) if columns.shape[1] > len(columns) else columns.T


class GrowingFactor:
    """Reduce a growing number of rows with p columns to their factor, `capacity` at a time."""

    def __init__(self, p: int, capacity: int = ROWS_AT_ONCE) -> None:
        self._p = p
        self._rows = np.empty((p, max(capacity, 1)))
        self._filled = 0
        self._known: Array | None = None
        """Factor so far, as columns."""

    def append(self, columns: Array, support: Indices | None = None) -> None:
        """Add rows given as columns (p, m): samples innermost.

        With `support` they are these columns (s, m) only, the others zero.
        """
        start = 0
        places = slice(None) if support is None else support
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
        if self._filled or self._known is None:
            self._reduce()
        return _make_diagonal_positive(np.asarray(self._known).T)

    def shortest(self) -> Array:
        """Return the rows (m, p) themselves where they are at most p, else their factor."""
        if self._known is None and self._filled <= self._p:
            return self._rows[:, : self._filled].T.copy()
        return self.factor()

    def _reduce(self) -> None:
        # Rows of zeros in front make the factor square, and give up to half a digit more.
        before = np.zeros((self._p, self._p)) if self._known is None else self._known
        rows = np.concatenate([before, self._rows[:, : self._filled]], axis=1).T
        # Columns that one block reflector takes. The panels of `geqrf` are as wide as these
        # matrices, so it works by vectors: with 30 to 60 columns `geqrt` takes half of its
        # time.
        lapack.dgeqrt(min(8, self._p), rows, overwrite_a=True)
        # Below the diagonal the reflections are left, and go.
        self._known = np.tril(rows[: self._p].T)
        self._filled = 0


@dataclass(frozen=True, slots=True, eq=False)
class FactorSolution:
    """Hold the minimiser x of `|W x - tau|`.

    `x = toward + D^-1 V S^-1 U^T (z - R toward)` over the `rank` singular values above
    `rank_tolerance`, columns scaled by D to unit length.

    Parameters
    ----------
    x
        Minimiser, shape (p,).
    rank
        Numeric rank of W.
    residual_energy
        Squared norm of the residual.
    inverse_root
        `D^-1 V S^-1`, shape (p, rank); times its transpose it is the pseudo-inverse of `W^T W`.
    open_directions
        Directions that do not change `W x`, in units of x, shape (p - rank, p).
    singular_values
        Of the scaled columns, largest first, shape (p,).
    condition_number, scaled_condition_number
        Of W, and with columns scaled to unit length; infinite without full rank.
    """

    x: Array
    rank: int
    residual_energy: float
    inverse_root: Array
    open_directions: Array
    singular_values: Array
    condition_number: float
    scaled_condition_number: float


def rank_tolerance(n_rows: int, n_columns: int) -> float:
    """Return `4 eps max(m, p)`, below which a relative singular value is rounding."""
    return 4.0 * float(np.finfo(np.float64).eps) * max(n_rows, n_columns)


def solve_factor(
    factor: Array, n_rows: int, toward: Array | None = None, ridge: float = 0.0
) -> FactorSolution:
    """Minimise `|W x - tau|^2 + ridge |D (x - toward)|^2` from the triangular factor [R | z].

    The factor (p + 1, p + 1) is of `n_rows` rows, and D scales columns to length 1,
    `R D^-1 = U S V^T`. Undetermined directions are resolved toward `toward` (p,), zero by default.
    Source: Golub & Van Loan, Matrix Computations, 2013, sections 5.3.5 (column scaling) and 5.5
    (rank).
    """
    p = len(factor) - 1
    r = factor[:p, :p]
    z = factor[:p, p]
    length = np.linalg.norm(r, axis=0)
    present = length > rank_tolerance(n_rows, p) * length.max(initial=0.0)
    # A column of nothing but rounding would be scaled up to noise.
    scale = np.where(present, length, 1.0)
    u, every, vt = np.linalg.svd(np.where(present, r / scale, 0.0))
    rank = int(np.sum(every > rank_tolerance(n_rows, p) * every.max(initial=0.0)))
    s = every[:rank]
    start = np.zeros(p) if toward is None else toward
    damped = np.sqrt(s**2 + ridge)
    inverse_root = (vt[:rank].T / damped) / scale[:, None]
    # From `toward` on, so that directions without information keep it.
    x = start + inverse_root @ ((s / damped) * (u[:, :rank].T @ (z - r @ start)))
    error = factor @ np.append(-x, 1.0)
    return FactorSolution(
        x=x,
        rank=rank,
        residual_energy=float(error @ error),
        inverse_root=inverse_root,
        open_directions=_reduce_to_echelon(vt[rank:], scale),
        singular_values=every,
        condition_number=_evaluate_condition(np.asarray(np.linalg.svd(r, compute_uv=False)), rank),
        scaled_condition_number=_evaluate_condition(every, rank),
    )


def solve_fast(factor: Array, n_rows: int, toward: Array | None) -> tuple[Array, Array]:
    """Return x and the inverse root of `solve_factor`, by substitution if well conditioned."""
    r = factor[:-1, :-1]
    scale = np.linalg.norm(r, axis=0)
    if np.all(scale > 0.0):
        scaled = r / scale
        # A singular value decomposition costs ten times as much as this inverse.
        inverse, singular = lapack.dtrtri(scaled)
        # Scaled condition number (Frobenius) up to which substitution is as good as singular
        # values.
        if not singular and np.linalg.norm(inverse) * np.linalg.norm(scaled) < 1e7:
            root = inverse / scale[:, None]
            return root @ factor[:-1, -1], root
    solution = solve_factor(factor, n_rows, toward)
    return solution.x, solution.inverse_root


def _reduce_to_echelon(null: Array, scale: Array) -> Array:
    """Return rows that span the rows of `null` / `scale`, few non-zeros, largest coefficient 1."""
    if len(null) == 0:
        return np.zeros((0, len(scale)))
    pivots = qr(null, mode="r", pivoting=True)[-1][: len(null)]
    reduced = np.linalg.solve(null[:, pivots], null)
    reduced[np.abs(reduced) < NEGLIGIBLE_COEFFICIENT] = 0.0
    rows = reduced / scale
    rows /= np.abs(rows).max(axis=1, keepdims=True)
    return np.asarray(rows[np.argsort(pivots)])


def _evaluate_condition(singular_values: Array, rank: int) -> float:
    full = rank == len(singular_values) and singular_values[-1] > 0
    return float(singular_values[0] / singular_values[-1]) if full else np.inf
