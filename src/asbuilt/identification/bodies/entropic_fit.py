"""Parameters of least divergence from CAD, given torques or base parameters.

Smooth and convex, solved by Newton's method, many problems side by side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.body_bounds import BodyBounds
from asbuilt.identification.bodies.cad_prior import (
    IDENTITY_SVEC,
    SVEC_COLUMN,
    SVEC_LENGTH,
    SVEC_ROW,
    CadPrior,
    smat,
    svec,
)
from asbuilt.identification.bodies.conic_fit import scale_near_one

BARRIER = 1e-3
"""Weight of the logarithmic barrier in squared weighted residuals, far below one standard error."""
CLOSE = 1e-9
"""Squared Newton decrement at the last step but one, in squared weighted residuals or weights."""

HESSIANS_AT_ONCE = 2**22
"""Bytes of the Hessians that are made at once: they stay in the cache until they are solved."""

# Hold when the steps of the fit are shortened, and when it ends.

# Largest relative distance of duals and multipliers from the central path at the end
NEWTON_CENTRAL = 0.5
NEWTON_ROUNDING = 1e-14  # Relative rise of the value that is rounding
NEWTON_MOST_STEPS = 300  # Most Newton steps of a fit
NEWTON_SUFFICIENT = 0.05  # Share of the promised decrease that a step must reach (Armijo)
NEWTON_SHORTER = 0.5  # Factor by which a step that does not is shortened,
NEWTON_SHORTEST = 1e-12  # ... down to this part of the whole step.
NEWTON_NEAR_EDGE = 0.95  # Part of the way to the nearest bound that a step may go


SIZES = Cure("check the data for values of extreme size")


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Split `chi = kept beta + dependent d`, so that `K chi = beta` for every d.

    K is the regrouping, `kept` (n_standard, p), `dependent` (n_standard, n_standard - p).
    """

    regrouping: Array
    kept: Array
    dependent: Array

    @classmethod
    def of(cls, base: BaseParameters) -> Coordinates:
        """Return the split that belongs to base parameters."""
        others = np.setdiff1d(np.arange(base.n_standard), base.columns)
        kept, dependent = (
            np.eye(base.n_standard).take(columns, axis=1) for columns in (base.columns, others)
        )
        # K chi = beta: what dependent parameters add to base parameters is taken off there.
        dependent[base.columns] = -base.regrouping[:, others]
        return cls(base.regrouping, kept, dependent)


@dataclass(frozen=True, slots=True, eq=False)
class EntropicFits:
    """Hold the minimisers `chi` (m, n_standard) of m problems and their `values` (m,).

    `duals` (m, n_links, 4, 4) of the links and `multipliers` (m, n_bounds) of the bounds start the
    search for another weight.
    """

    chi: Array
    values: Array
    duals: Array
    multipliers: Array

    def repeat_last(self, m: int) -> EntropicFits:
        """Return the fit of the last problem as the start of m others."""
        return EntropicFits(
            *(
                np.repeat(array[-1:], m, axis=0)
                for array in (self.chi, self.values, self.duals, self.multipliers)
            )
        )


class EntropicProblem:
    """Minimise `|R K chi - z|^2 / 2 + weight sum_i D(P_i || P0_i)` for many factors [R z].

    D is the divergence of `CadPrior`. With `held` base parameters there are no torques, and `K chi`
    stays what it is at the start, exactly. Bounds enter with a logarithmic barrier. The variables
    are the same as in `ConicProblem`, `Q_i = L_i^-1 P_i L_i^-T`, `P0_i = L_i L_i^T`.
    Newton's method on a self-concordant function with a line search; the Hessian of a link is taken
    as `W^-1 (x) W^-1`, `W Z W = Q`, halfway between the link and its dual `Z -> weight Q^-1`; so is
    the Hessian of a bound, to anticipate boundaries far from the start (Nesterov & Todd, SIAM J.
    Optimization 8, 1998; Boyd & Vandenberghe, Convex Optimization, 2004, sections 9.6 and 11.7;
    Lee, Wensing & Park, IEEE Trans. Robotics 36, 2020).
    """

    def __init__(
        self,
        prior: CadPrior,
        coordinates: Coordinates,
        bounds: BodyBounds | None = None,
        *,
        held: bool = False,
    ) -> None:
        self.prior = prior
        self.regrouping = coordinates.regrouping
        scale, self.q0 = scale_near_one(prior)
        self.whitening = np.linalg.inv(scale)
        self.inertial = 10 * prior.n_links
        self.free = coordinates.dependent if held else scale
        # Held, steps go along the dependent parameters alone, and K chi is exact.
        self.along = self.whitening @ self.free if held else np.eye(len(scale))
        self.torque = coordinates.regrouping @ self.free
        self.rows = np.zeros((0, len(scale))) if bounds is None else bounds.rows
        self.offsets = np.zeros(0) if bounds is None else bounds.offsets
        self.slopes = self.rows @ self.free
        # Most bounds are of drives, one column each: what no bound has costs no product.
        self.bounded = np.flatnonzero(self.slopes.any(axis=0))
        self.held = held
        self._reduced: tuple[Array, Array, Array] | None = None

    def reduce(self, factors: Array) -> tuple[Array, Array]:
        """Return the torques of the free coordinates A (m, p, v), and their Gram matrices.

        The same factors are fitted with one weight after another.
        """
        if self._reduced is None or self._reduced[0] is not factors:
            A = factors[:, :-1, :-1] @ self.torque
            self._reduced = factors, A, _transpose(A) @ A
        return self._reduced[1:]

    def curve(self, hessians: Array, scaling: Array) -> None:
        """Add divergences and drives at W^-1 (m, n_links, 4, 4) to the Hessians (m, v, v)."""
        n = self.inertial
        pairs = (
            scaling[..., SVEC_ROW[:, None], SVEC_ROW]
            * scaling[..., SVEC_COLUMN[:, None], SVEC_COLUMN]
        )
        pairs += (
            scaling[..., SVEC_ROW[:, None], SVEC_COLUMN]
            * scaling[..., SVEC_COLUMN[:, None], SVEC_ROW]
        )
        # svec(W^-1 Z W^-1): the symmetric Kronecker product, in pairs of places.
        blocks = 0.5 * np.outer(SVEC_LENGTH, SVEC_LENGTH) * pairs
        if self.held:
            parts = self.along[:n].reshape(-1, 10, self.along.shape[1])
            drives = self.along[n:]
            hessians += (_transpose(parts) @ blocks @ parts).sum(
                axis=1
            ) + self.prior.drive_weight * drives.T @ drives
            return
        # Links do not act on each other here: their blocks stand on the diagonal.
        for i in range(len(blocks[0])):
            hessians[:, 10 * i : 10 * i + 10, 10 * i : 10 * i + 10] += blocks[:, i]
        drive = range(n, len(self.q0))
        hessians[:, drive, drive] += self.prior.drive_weight

    def fit(
        self,
        factors: Array | None,
        weight: float,
        start: Array | EntropicFits,
        *,
        barrier: float = BARRIER,
        close: float = CLOSE,
    ) -> EntropicFits:
        """Return the minima for factors (m, p + 1, p + 1) from a feasible `start`.

        Raises `IdentifiabilityError` if a start is not strictly feasible, or a descent stalls.
        """
        search = _Search(self, factors, weight, barrier, start)
        if not np.all(np.isfinite(search.values)):
            raise IdentifiabilityError(
                f"the entropic fit of {self.prior.robot} needs consistent starting values strictly"
                " inside the bounds"
            )
        # Each problem stops by itself, so that its result does not depend on the others.
        active = np.arange(len(search.y))
        steps = 0
        while active.size and steps < NEWTON_MOST_STEPS:
            active = active[~search.advance(active, close)]
            steps = steps + 1
        if active.size:
            raise IdentifiabilityError(
                f"the entropic fit of {self.prior.robot} did not converge: the squared Newton"
                f" decrement is {search.decrements[active].max():.3g} after {steps} steps",
                cure=SIZES,
            )
        return EntropicFits(
            search.start + search.y @ self.free.T,
            search.values,
            search.duals,
            search.multipliers,
        )


class _Search:
    """Hold the state of m descents.

    Steps `y` (m, v) along the free coordinates, bodies and drives `q`, `error` of the torque,
    `slack` of the bounds, Cholesky `roots` of the bodies, `duals`, `multipliers`, `values` and
    squared Newton `decrements`.
    """

    def __init__(
        self,
        problem: EntropicProblem,
        factors: Array | None,
        weight: float,
        barrier: float,
        start: Array | EntropicFits,
    ) -> None:
        self.problem = problem
        self.weight = weight
        self.barrier = barrier
        self.weights = weight * problem.prior.strength
        self.start = start.chi if isinstance(start, EntropicFits) else start
        m = len(self.start)
        v = problem.free.shape[1]
        self.A = np.zeros((m, 0, v))
        self.error = np.zeros((m, 0))
        self.gram = np.zeros((m, v, v))
        if factors is not None:
            self.A, self.gram = problem.reduce(factors)
            self.error = (
                _multiply_vectors(factors[:, :-1, :-1], self.start @ problem.regrouping.T)
                - factors[:, :-1, -1]
            )
        self.y = np.zeros((m, v))
        self.q = self.start @ problem.whitening.T
        self.slack = self.start @ problem.rows.T + problem.offsets
        self.values, self.roots = self._evaluated(self.q, self.error, self.slack)
        self.decrements = np.full(m, np.inf)
        if isinstance(start, EntropicFits):
            self.duals = start.duals.copy()
            self.multipliers = start.multipliers.copy()
        else:
            inverse = np.asarray(np.linalg.inv(self.roots), dtype=np.float64)
            # On the central path: Z = weight Q^-1, and slack times multiplier is the barrier.
            self.duals = self.weights[:, None, None] * (_transpose(inverse) @ inverse)
            self.multipliers = barrier / self.slack

    def model(self, a: Indices | slice) -> tuple[Array, Array, Array]:
        """Return gradients, T (m, n_links, 4, 4) and V (m, n_links, 4) of problems a.

        T takes links and duals to the same diagonal, `T Q T^T = T^-T Z T^-1 = diag(V)`.
        """
        problem = self.problem
        n = self.problem.inertial
        q = self.q[a]
        roots = self.roots[a]
        inverse = np.asarray(np.linalg.inv(roots), dtype=np.float64)
        # Eigenvalues V^2 of L^T Z L, Q = L L^T: T Q T^T = T^-T Z T^-1 = diag(V).
        size, turn = np.linalg.eigh(_transpose(roots) @ self.duals[a] @ roots)
        V = np.sqrt(np.maximum(size, np.finfo(np.float64).tiny))
        T = np.sqrt(V)[..., None] * (_transpose(turn) @ inverse)
        # d/dQ of tr(Q) - log det Q is 1 - Q^-1.
        bodies = self.weights[:, None] * np.asarray(
            IDENTITY_SVEC - svec(_transpose(inverse) @ inverse)
        )
        drives = problem.prior.drive_weight * (q[:, n:] - problem.q0[n:])
        slope = np.hstack([bodies.reshape(len(q), -1), drives])
        gradient = _multiply_vectors(_transpose(self.A[a]), self.error[a]) + (
            slope @ problem.along if problem.held else slope
        )
        # Of -barrier log(slack).
        gradient -= (self.barrier / self.slack[a]) @ problem.slopes
        return gradient, T, V

    def hessians(self, a: Indices, T: Array) -> Array:
        """Return the Hessians (m, v, v) of problems a, with their T (m, n_links, 4, 4)."""
        problem = self.problem
        slopes = problem.slopes[:, problem.bounded]
        hessian = self.gram[a]
        # Multipliers in place of barrier / slack: the Hessian halfway to the boundary.
        hessian[:, problem.bounded[:, None], problem.bounded] += (
            slopes.T * (self.multipliers[a] / self.slack[a])[:, None, :]
        ) @ slopes
        problem.curve(hessian, _transpose(T) @ T)
        return hessian

    def advance(self, active: Indices, close: float) -> NDArray[np.bool_]:
        """Take one step of the active problems, and return which of them have arrived."""
        problem = self.problem
        m = len(active)
        n = self.problem.inertial
        # A slice is a view: the usual case of all problems copies nothing.
        a: Indices | slice = active if m < len(self.y) else slice(None)
        error = self.error[a]
        q = self.q[a]
        slack = self.slack[a]
        multipliers = self.multipliers[a]
        strength = self.weights[:, None]
        gradient, T, V = self.model(a)
        step = -self._solve(active, gradient, T)
        self.decrements[a] = -np.sum(gradient * step, axis=1)
        change = step @ problem.along.T if problem.held else step
        narrowing = step @ problem.slopes.T
        swing = _multiply_vectors(self.A[a], step)

        X = T @ smat(change[:, :n].reshape(m, -1, 10)) @ _transpose(T)
        # Z Q = weight linearised in the scaled space, where both are diag(V).
        Y = (strength / V - V)[..., None] * np.eye(4) - X
        # slack multiplier = barrier, linearised.
        loosening = (self.barrier - multipliers * narrowing) / slack - multipliers
        length = _find_step_length(X, V, -narrowing / slack)
        dual_length = _find_step_length(Y, V, -loosening / multipliers)
        # Duals take their own step, as they meet their boundary elsewhere.
        self.duals[a] += dual_length[:, None, None, None] * (_transpose(T) @ Y @ T)
        self.multipliers[a] += dual_length[:, None] * loosening

        # Backtracking of each problem alone: Armijo, and infinity outside the domain.
        trying = np.arange(m)
        while trying.size:
            b = active[trying]
            far = length[trying, None]
            tried = (
                q[trying] + far * change[trying],
                error[trying] + far * swing[trying],
                slack[trying] + far * narrowing[trying],
            )
            values, roots = self._evaluated(*tried)
            promised = NEWTON_SUFFICIENT * length[trying] * np.maximum(self.decrements[b], 0.0)
            # Near the minimum the promised decrease is less than rounding of the value.
            good = values <= self.values[b] - promised + NEWTON_ROUNDING * np.abs(self.values[b])
            kept = b[good]
            self.y[kept] += (far * step[trying])[good]
            self.q[kept], self.error[kept], self.slack[kept] = (state[good] for state in tried)
            self.values[kept] = values[good]
            self.roots[kept] = roots[good]
            trying = trying[~good]
            length[trying] *= NEWTON_SHORTER
            trying = trying[length[trying] > NEWTON_SHORTEST]
        # Off the central path the decrement is small without being at the minimum.
        off = np.maximum(
            np.max(np.abs(V**2 / strength - 1.0), axis=(1, 2), initial=0.0),
            np.max(np.abs(slack * multipliers / self.barrier - 1.0), axis=1, initial=0.0),
        )
        return np.asarray(
            (np.abs(self.decrements[a]) <= close * min(self.weight, 1.0)) & (off <= NEWTON_CENTRAL)
        )

    def _solve(self, a: Indices, gradients: Array, T: Array) -> Array:
        """Return what the Hessians of problems a take to their gradients, (m, v)."""
        solved = np.empty_like(gradients)
        at_once = max(1, HESSIANS_AT_ONCE // max(8 * gradients.shape[1] ** 2, 1))
        for first in range(0, len(a), at_once):
            part = slice(first, first + at_once)
            hessians = self.hessians(a[part], T[part])
            for found, hessian, gradient in zip(
                solved[part], hessians, gradients[part], strict=True
            ):
                # Positive definite: half of the work of a general matrix. Transposed, LAPACK finds
                # its columns in place.
                _, x, failed = lapack.dposv(hessian.T, gradient, lower=1)
                if failed:
                    # Indefinite by rounding, as far from the minimum.
                    _, _, x, failed = lapack.dgesv(hessian.T, gradient)
                if failed:
                    raise IdentifiabilityError(
                        f"the entropic fit of {self.problem.prior.robot} has a singular Hessian",
                        cure=SIZES,
                    )
                found[:] = x
        return solved

    def _evaluated(self, q: Array, error: Array, slack: Array) -> tuple[Array, Array]:
        """Return values and Cholesky roots of the links; infinite values outside."""
        problem = self.problem
        n = self.problem.inertial
        bodies = q[:, :n].reshape(len(q), n // 10, 10)
        drives = q[:, n:] - problem.q0[n:]
        roots = _factor_matrices(smat(bodies))
        with np.errstate(divide="ignore", invalid="ignore"):
            value = (
                bodies @ IDENTITY_SVEC
                - 2.0 * np.log(np.diagonal(roots, axis1=2, axis2=3)).sum(axis=2)
                # `- 4 n` is left out: a constant.
            ) @ self.weights
            value += 0.5 * (
                problem.prior.drive_weight * np.sum(drives**2, axis=1) + np.sum(error**2, axis=1)
            ) - self.barrier * np.log(slack).sum(axis=1)
        return np.where(np.isfinite(value), value, np.inf), roots


def _transpose(matrices: Array) -> Array:
    return matrices.swapaxes(-1, -2)


def _multiply_vectors(matrices: Array, vectors: Array) -> Array:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _find_step_length(change: Array, V: Array, approach: Array) -> Array:
    """Return how much of a step each problem may take.

    `change` is what the step does to links at diag(V), `approach` (m, n_bounds) how far it goes to
    each bound.
    """
    root = np.sqrt(V)
    # 1 + length eigenvalue > 0 keeps the body positive definite.
    edge = -np.linalg.eigvalsh(change / (root[..., :, None] * root[..., None, :])).min(axis=(1, 2))
    nearest = np.column_stack([edge, approach]).max(axis=1)
    tiny = np.finfo(np.float64).tiny
    return np.asarray(np.minimum(1.0, NEWTON_NEAR_EDGE / np.maximum(nearest, tiny)))


def _factor_matrices(matrices: Array) -> Array:
    """Return the Cholesky roots of (m, l, 4, 4) matrices; NaN for those not positive definite."""
    try:
        return np.asarray(np.linalg.cholesky(matrices))
    # One inconsistent body fails the whole stack; the others are factored without it.
    except np.linalg.LinAlgError:
        inside = np.linalg.eigvalsh(matrices)[..., 0] > 0.0
        roots = np.full(matrices.shape, np.nan)
        roots[inside] = np.linalg.cholesky(matrices[inside])
        return roots
