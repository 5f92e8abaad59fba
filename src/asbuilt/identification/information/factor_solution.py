"""Least squares from a triangular factor, with rank, conditioning and open directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, qr

from asbuilt.arrays import Array
from asbuilt.identification.information.square_root_information import SquareRootInformation

NEGLIGIBLE_COEFFICIENT = 1e-6


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


@dataclass(frozen=True, slots=True, eq=False)
class Weighted:
    """Hold `R D^-1 = U S V^T` of the triangular factor [R | z] of weighted rows.

    D scales columns to length 1. Only the `rank` singular values above `rank_tolerance` are in `u`,
    `s`, `vt`; `null` (p - rank, p) are the other right vectors. Undetermined directions are
    resolved toward `toward`. Source: Golub & Van Loan, Matrix Computations, 2013, sections 5.3.5
    (column scaling) and 5.5 (rank).
    """

    factor: Array
    toward: Array
    scale: Array
    u: Array
    s: Array
    vt: Array
    null: Array
    singular_values: Array

    @classmethod
    def factored(cls, factor: Array, n_rows: int, toward: Array | None = None) -> Weighted:
        """Decompose a triangular factor (p + 1, p + 1) of `n_rows` rows."""
        p = len(factor) - 1
        r = factor[:p, :p]
        length = np.linalg.norm(r, axis=0)
        present = length > rank_tolerance(n_rows, p) * length.max(initial=0.0)
        scale = np.where(present, length, 1.0)
        u, s, vt = np.linalg.svd(np.where(present, r / scale, 0.0))
        rank = int(np.sum(s > rank_tolerance(n_rows, p) * s.max(initial=0.0)))
        start = np.zeros(p) if toward is None else np.asarray(toward, dtype=np.float64)
        return cls(factor, start, scale, u[:, :rank], s[:rank], vt[:rank], vt[rank:], s)

    @classmethod
    def of(
        cls, information: SquareRootInformation, weights: Array, toward: Array | None = None
    ) -> Weighted:
        """Decompose the information of all joints, joint k multiplied by `weights[k]`."""
        return cls.factored(information.stacked(weights), information.n_rows, toward)

    def solve(self, ridge: float = 0.0) -> FactorSolution:
        """Return the solution of least squares, with `ridge |D (x - toward)|^2` added."""
        p = len(self.factor) - 1
        r, z = self.factor[:p, :p], self.factor[:p, p]
        damped = np.sqrt(self.s**2 + ridge)
        inverse_root = (self.vt.T / damped) / self.scale[:, None]
        x = self.toward + inverse_root @ ((self.s / damped) * (self.u.T @ (z - r @ self.toward)))
        plain: Array = np.asarray(np.linalg.svd(r, compute_uv=False), dtype=np.float64)
        error = self.factor @ np.append(-x, 1.0)
        rank = len(self.s)
        return FactorSolution(
            x=x,
            rank=rank,
            residual_energy=float(error @ error),
            inverse_root=inverse_root,
            open_directions=_reduce_to_echelon(self.null, self.scale),
            singular_values=self.singular_values,
            condition_number=_evaluate_condition(plain, rank),
            scaled_condition_number=_evaluate_condition(self.singular_values, rank),
        )


def solve_factor(factor: Array, n_rows: int, toward: Array | None = None) -> FactorSolution:
    """Solve least squares from the triangular factor (p + 1, p + 1) of `n_rows` rows.

    Undetermined directions are resolved toward `toward` (p,), zero by default.
    """
    return Weighted.factored(factor, n_rows, toward).solve()


def solve_fast(factor: Array, n_rows: int, toward: Array | None) -> tuple[Array, Array]:
    """Return x and the inverse root of `solve_factor`, by substitution if well conditioned."""
    r = factor[:-1, :-1]
    scale = np.linalg.norm(r, axis=0)
    if np.all(scale > 0.0):
        scaled = r / scale
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
    _, _, pivots = qr(null, mode="economic", pivoting=True)
    reduced = np.linalg.solve(null[:, pivots[: len(null)]], null)
    reduced[np.abs(reduced) < NEGLIGIBLE_COEFFICIENT] = 0.0
    rows = reduced / scale
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)
    return np.asarray(rows[np.argsort(pivots[: len(null)])])


def _evaluate_condition(singular_values: Array, rank: int) -> float:
    p = len(singular_values)
    return (
        float(singular_values[0] / singular_values[-1])
        if rank == p and singular_values[-1] > 0
        else np.inf
    )
