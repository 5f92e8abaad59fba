"""Least squares on square-root information, ordinary or with a weight per joint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack, qr

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import Cure, Finding
from asbuilt.identification.estimators.methods import estimator
from asbuilt.identification.information.square_root_information import SquareRootInformation

if TYPE_CHECKING:
    from asbuilt.identification.information.estimation_data import EstimationData

Weighting = Literal["joint"]
Refit = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""A fit of the triangular factor [R z] (p + 1, p + 1) of weighted rows: beta (p,)."""

WEIGHT_CONVERGENCE = 1e-8
MOST_ITERATIONS = 50
WELL_CONDITIONED = 1e7
"""Scaled condition number (Frobenius) up to which substitution is as good as singular values."""
SMALLEST_NOISE = 1e-9
"""Least noise of a joint in the largest torque RMS; simulations have none."""
LARGE_CONDITION = 200.0
"""Scaled condition number above which model errors are amplified (below 100 is good: Gautier and
Khalil, Int. J. Robotics Research 11, 1992).
"""
NEGLIGIBLE_COEFFICIENT = 1e-6
MOST_TERMS = 6


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
        return cls.factored(
            information.stacked(weights), information.n_samples * information.n_joints, toward
        )

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
            open_directions=_echelon(self.null, self.scale),
            singular_values=self.singular_values,
            condition_number=_ratio(plain, rank),
            scaled_condition_number=_ratio(self.singular_values, rank),
        )


def solve_factor(factor: Array, n_rows: int, toward: Array | None = None) -> FactorSolution:
    """Solve least squares from the triangular factor (p + 1, p + 1) of `n_rows` rows.

    Undetermined directions are resolved toward `toward` (p,), zero by default.
    """
    return Weighted.factored(factor, n_rows, toward).solve()


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Hold an estimate of p base parameters from n joints.

    Parameters
    ----------
    method
        Name of the estimator.
    beta
        Base parameters, shape (p,).
    covariance
        Textbook covariance (p, p), `inverse_root inverse_root^T` times the residual variance.
    sigma
        Residual standard deviation of each joint, shape (n,).
    weights
        Factors of the rows of each joint, shape (n,).
    solution
        Rank, conditioning and the inverse root of the information.
    undetermined
        Directions that this recording does not determine, as text.
    determined
        False for the parameters in such directions, which keep the prior there, shape (p,).
    iterations, converged
        Of the weights, or whatever the estimator iterates.
    information
        What the solution solves, if not the information of the samples (such as reweighted rows).
    notes, findings
        What was decided, and what is wrong with it.
    dropped
        Parameters set to zero as insignificant, shape (p,); None if the method drops none.
    refit
        Gives beta for the triangular factor of other rows with equal weights, all choices fixed;
        None if beta is linear in the torque.
    """

    method: str
    beta: Array
    covariance: Array
    sigma: Array
    weights: Array
    solution: FactorSolution
    undetermined: tuple[str, ...]
    determined: NDArray[np.bool_]
    iterations: int
    converged: bool
    information: SquareRootInformation | None = None
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    dropped: NDArray[np.bool_] | None = None
    refit: Refit | None = None

    @property
    def rank(self) -> int:
        """Rank of this recording."""
        return self.solution.rank

    @property
    def std_errors(self) -> Array:
        """Textbook standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def renewed(
        self,
        method: str,
        information: SquareRootInformation,
        solution: FactorSolution,
        *,
        beta: Array | None = None,
        inverse_root: Array | None = None,
        sigma: Array | None = None,
        own_information: SquareRootInformation | None = None,
        iterations: int | None = None,
        converged: bool | None = None,
        notes: tuple[str, ...] = (),
        dropped: NDArray[np.bool_] | None = None,
    ) -> Estimate:
        """Return another method's estimate in the same directions, its errors by `information`."""
        found = solution.x if beta is None else beta
        root = solution.inverse_root if inverse_root is None else inverse_root
        error = information.stacked(self.weights) @ np.append(-found, 1.0)
        energy, n_rows = float(error @ error), information.n_samples * information.n_joints
        return replace(
            self,
            method=method,
            beta=found,
            covariance=energy / max(n_rows - root.shape[1], 1) * root @ root.T,
            sigma=(
                residual_deviation(information, found, solution.inverse_root, self.weights)
                if sigma is None
                else sigma
            ),
            solution=replace(solution, x=found, residual_energy=energy, inverse_root=root),
            iterations=self.iterations if iterations is None else iterations,
            converged=self.converged if converged is None else converged,
            information=own_information,
            notes=notes,
            dropped=dropped,
            refit=None,
        )


def noise_floor(information: SquareRootInformation) -> float:
    """Return the least noise: `SMALLEST_NOISE` of the largest torque RMS, 1 without torque."""
    return (
        SMALLEST_NOISE * float(np.sqrt(information.torque_energy.max() / information.n_samples))
        or 1.0
    )


def fit_least_squares(
    information: SquareRootInformation,
    *,
    weights: Weighting | ArrayLike | None = None,
    prior: ArrayLike | None = None,
    undetermined: Literal["toward_prior", "refuse"] = "toward_prior",
) -> Estimate:
    """Minimise `sum_k weights_k^2 |tau_k - W_k beta|^2`.

    Parameters
    ----------
    information
        Square-root information of n joints and p base parameters.
    weights
        None for ordinary least squares; `"joint"` for 1 / sigma_k with `sigma_k^2 = |e_k|^2 / (N -
        t_k)`, t_k the parameters that joint k spends, iterated to convergence (Gautier, IROS 1997);
        or n positive numbers.
    prior
        Values (p,) toward which undetermined directions are resolved by the smallest change in
        parameters scaled to equal torque; NaN counts as 0.
    undetermined
        `"refuse"` raises for undetermined directions.

    Raises
    ------
    IdentifiabilityError
        If directions are undetermined without prior or refused, or rows are fewer than parameters.
    """
    n, rows = information.n_joints, information.n_samples
    if rows * n <= information.base.n_base:
        raise IdentifiabilityError(
            f"{rows} samples of {n} joints give {rows * n} torques, too few for"
            f" {information.base.n_base} parameters of {information.base.robot}",
            cure=Cure("record longer, decimate less or choose fewer drive terms"),
        )
    toward = None if prior is None else np.nan_to_num(np.asarray(prior, dtype=np.float64), nan=0.0)
    floor = noise_floor(information)
    iterated = isinstance(weights, str)
    if iterated and weights != "joint":
        raise UsageError(
            f"weights {weights!r} are unknown; expected 'joint', None or {n} positive numbers, one"
            " per joint"
        )
    w = np.ones(n) if weights is None or isinstance(weights, str) else positive_weights(weights, n)
    iterations, converged = 0, True
    with one_blas_thread():
        while True:
            iterations += 1
            if not iterated:
                break
            x, root = _solved(information.stacked(w), rows * n, toward)
            renewed = 1.0 / np.maximum(residual_deviation(information, x, root, w), floor)
            converged = bool(np.all(np.abs(renewed - w) <= WEIGHT_CONVERGENCE * renewed))
            if converged or iterations > MOST_ITERATIONS:
                break
            w = renewed
        solution = solve_factor(information.stacked(w), rows * n, toward)
        sigma = residual_deviation(information, solution.x, solution.inverse_root, w)
    if solution.rank < information.base.n_base and (toward is None or undetermined == "refuse"):
        raise _refusal(information, solution)
    variance = solution.residual_energy / max(rows * n - solution.rank, 1)
    return Estimate(
        method="ols" if weights is None else "wls",
        beta=solution.x,
        covariance=variance * solution.inverse_root @ solution.inverse_root.T,
        sigma=sigma,
        weights=w,
        solution=solution,
        undetermined=tuple(
            combination(direction, information.base.names) for direction in solution.open_directions
        ),
        determined=np.all(np.abs(solution.open_directions) <= NEGLIGIBLE_COEFFICIENT, axis=0),
        iterations=iterations,
        converged=converged,
    )


@estimator("ols", "ordinary least squares", "equal weight for every torque", held_fixed=())
def estimate_ols(data: EstimationData) -> Estimate:
    """Estimate by ordinary least squares: equal weight for every torque."""
    return fit_least_squares(data.information, prior=data.prior, undetermined=data.undetermined)


@estimator("wls", "weighted least squares", "a weight per joint, from its own noise")
def estimate_wls(data: EstimationData) -> Estimate:
    """Estimate by least squares with a weight per joint."""
    return fit_least_squares(
        data.information, weights="joint", prior=data.prior, undetermined=data.undetermined
    )


def combination(direction: Array, names: tuple[str, ...]) -> str:
    """Return a direction as readable text, largest coefficient 1 in front.

    >>> combination(np.array([0.0, -0.5, 1.0]), ("Ixx1", "mx2", "Fv1"))
    'Fv1 - 0.5 mx2'
    """
    order = np.argsort(-np.abs(direction), kind="stable")
    lead = direction[order[0]]
    shown = [int(j) for j in order if abs(direction[j]) > NEGLIGIBLE_COEFFICIENT * abs(lead)]
    text = names[shown[0]]
    for j in shown[1:MOST_TERMS]:
        factor = direction[j] / lead
        size = f"{abs(factor):.3g}"
        text += f" {'-' if factor < 0 else '+'} {names[j] if size == '1' else f'{size} {names[j]}'}"
    return text + (f" + ... ({len(shown) - MOST_TERMS} more)" if len(shown) > MOST_TERMS else "")


def _solved(factor: Array, n_rows: int, toward: Array | None) -> tuple[Array, Array]:
    """Return x and the inverse root of `solve_factor`, by substitution if well conditioned."""
    r = factor[:-1, :-1]
    scale = np.linalg.norm(r, axis=0)
    if np.all(scale > 0.0):
        scaled = r / scale
        inverse, singular = lapack.dtrtri(scaled)
        if not singular and np.linalg.norm(inverse) * np.linalg.norm(scaled) < WELL_CONDITIONED:
            root = inverse / scale[:, None]
            return root @ factor[:-1, -1], root
    solution = solve_factor(factor, n_rows, toward)
    return solution.x, solution.inverse_root


def residual_deviation(
    information: SquareRootInformation, beta: Array, inverse_root: Array, weights: Array
) -> Array:
    """Return the standard deviation of each joint's residual, shape (n,)."""
    spent = _spent(information, inverse_root, weights)
    return np.asarray(
        np.sqrt(information.residual_energy(beta) / np.maximum(information.n_samples - spent, 1.0))
    )


def _spent(information: SquareRootInformation, inverse_root: Array, weights: Array) -> Array:
    """Return the trace (n,) of each joint's part of the hat matrix; the sum is the rank."""
    parts = []
    for support, factor, weight in zip(
        information.support, information.joint_factors, weights, strict=True
    ):
        part = weight * factor[:-1, :-1] @ inverse_root[support]
        parts.append(float(np.sum(part * part)))
    return np.array(parts)


def _refusal(information: SquareRootInformation, solution: FactorSolution) -> IdentifiabilityError:
    names = [
        combination(direction, information.base.names) for direction in solution.open_directions
    ]
    listed = "; ".join(names[:8]) + (f"; and {len(names) - 8} more" if len(names) > 8 else "")
    return IdentifiabilityError(
        f"the recording determines {solution.rank} of {information.base.n_base} parameters of"
        f" {information.base.robot}; undetermined: {listed}",
        cure=Cure(
            "move the joints concerned more (several at once, both directions, changing speed), or"
            " resolve these directions toward CAD",
            settings={"undetermined": "toward_prior"},
        ),
    )


def positive_weights(weights: ArrayLike, n: int) -> Array:
    """Return weights of n joints as an array; raises `UsageError` unless n positive numbers."""
    w = np.asarray(weights, dtype=np.float64)
    if w.shape != (n,) or not np.all(np.isfinite(w)) or np.any(w <= 0):
        raise UsageError(f"weights must be {n} positive numbers, one per joint, got {w.tolist()}")
    return w


def _echelon(null: Array, scale: Array) -> Array:
    """Return rows spanning those of `null` / `scale` with few non-zeros, largest coefficient 1."""
    if len(null) == 0:
        return np.zeros((0, len(scale)))
    _, _, pivots = qr(null, mode="economic", pivoting=True)
    reduced = np.linalg.solve(null[:, pivots[: len(null)]], null)
    reduced[np.abs(reduced) < NEGLIGIBLE_COEFFICIENT] = 0.0
    rows = reduced / scale
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)
    return np.asarray(rows[np.argsort(pivots[: len(null)])])


def _ratio(singular_values: Array, rank: int) -> float:
    p = len(singular_values)
    return (
        float(singular_values[0] / singular_values[-1])
        if rank == p and singular_values[-1] > 0
        else np.inf
    )
