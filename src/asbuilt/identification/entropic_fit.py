"""The bodies closest to CAD in entropy, given torques or exact base parameters: smooth and convex, solved by Newton's method in milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular

from asbuilt.description.inertia import pseudo_inertias
from asbuilt.dynamics.base_parameters import BaseParameters
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.body_bounds import BodyBounds
from asbuilt.identification.cad_prior import PSEUDO_INERTIA_BASIS, CadPrior, svec

Array = NDArray[np.float64]

DRIVE_RIDGE = 1e-6
"""Pull of drive parameters toward CAD, or toward zero, that decides only what nothing else does."""
BARRIER = 1e-3
"""Weight of the logarithm that keeps a bounded parameter off its bound, in units of the squared weighted residual: far below one standard error."""
CLOSE = 1e-12
"""Squared Newton decrement, per unit of weight, at which the minimum is reached."""
CLOSE_ENOUGH = 1e-5
"""The same where rounding allows no further descent."""
FIRST_BARRIER = 1e3
BARRIER_STAGES = 4
"""Where a direct descent does not arrive in a few steps, the bounds are approached in stages."""
FEW_STEPS = 30
MOST_STEPS = 300
SUFFICIENT = 0.2
SHORTER = 0.5
NEAR_EDGE = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Split the standard parameters: `chi = kept beta + dependent d`, so that `K chi = beta` whatever d (K is the regrouping, 1 on its own columns).

    `kept` (n_standard, p), `dependent` (n_standard, n_standard - p).
    """

    regrouping: Array
    kept: Array
    dependent: Array

    @classmethod
    def of(cls, base: BaseParameters) -> Coordinates:
        """Return the split that belongs to base parameters."""
        others = np.setdiff1d(np.arange(base.n_standard), base.columns)
        kept = np.zeros((base.n_standard, base.n_base))
        kept[base.columns, np.arange(base.n_base)] = 1.0
        dependent = np.zeros((base.n_standard, len(others)))
        dependent[others, np.arange(len(others))] = 1.0
        dependent[base.columns] = -base.regrouping[:, others]
        return cls(base.regrouping, kept, dependent)

    @property
    def n_base(self) -> int:
        """Number of base parameters."""
        return int(self.kept.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class EntropicFit:
    """Hold the minimiser `chi` (n_standard,), the value there, and how many Newton steps it took."""

    chi: Array
    value: float
    steps: int


def closest_to_cad(
    prior: CadPrior,
    coordinates: Coordinates,
    start: Array,
    *,
    weight: float = 1.0,
    factor: Array | None = None,
    bounds: BodyBounds | None = None,
    barrier: float = BARRIER,
) -> EntropicFit:
    """Minimise `|R K chi - z|^2 / 2 + weight sum_i D(P_i || P0_i)` over the standard parameters, from the triangular factor [R z] (p + 1, p + 1).

    D is the divergence of `CadPrior`. Without `factor`, `K chi` stays what it is at `start`, exactly. `start` must lie strictly inside: positive definite
    bodies, `bounds` kept with room to spare. Bounds enter with a logarithmic barrier. Newton's method on a self-concordant function, each step solved by QR of the
    stacked roots, so that nothing is squared (Boyd & Vandenberghe, Convex Optimization, 2004, section 9.6; Lee, Wensing & Park, 2020).

    Raises `IdentifiabilityError` where `start` is outside, or the descent stalls.
    """
    chi = np.array(start, dtype=np.float64)
    problem = _Problem(prior, coordinates, weight, factor, bounds)
    if not np.isfinite(problem.value(chi, barrier)):
        raise IdentifiabilityError(f"the search for bodies of {prior.robot} must start from possible bodies inside the bounds")
    found = _descend(problem, chi, barrier, FEW_STEPS)
    steps = found.steps
    if found.converged:
        return EntropicFit(found.chi, found.value, steps)
    stages = [barrier] if bounds is None or not len(bounds.offsets) else [*np.geomspace(FIRST_BARRIER, barrier, BARRIER_STAGES)]
    for stage in stages:
        found = _descend(problem, chi, stage, MOST_STEPS)
        chi, steps = found.chi, steps + found.steps
    if not found.converged:
        raise IdentifiabilityError(
            f"no closest bodies of {prior.robot} were found: after {steps} Newton steps the squared decrement is still {found.decrement:.3g}; "
            "the data may hold values of extreme size"
        )
    return EntropicFit(chi, found.value, steps)


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    chi: Array
    value: float
    steps: int
    decrement: float
    converged: bool


def _descend(problem: _Problem, chi: Array, barrier: float, most_steps: int) -> _Descent:
    value, decrement = problem.value(chi, barrier), np.inf
    for steps in range(most_steps):
        gradient, root = problem.model(chi, barrier)
        y = solve_triangular(root, -gradient, trans="T")
        decrement = float(y @ y)
        if decrement <= CLOSE * problem.weight:
            return _Descent(chi, value, steps, decrement, True)
        direction = problem.directions @ solve_triangular(root, y)
        length = min(1.0, NEAR_EDGE * problem.room(chi, direction))
        renewed = problem.value(chi + length * direction, barrier)
        while not renewed <= value - SUFFICIENT * length * decrement:
            length *= SHORTER
            if length * decrement <= CLOSE * max(problem.weight, abs(value)):
                return _Descent(chi, value, steps, decrement, decrement <= CLOSE_ENOUGH * max(problem.weight, 1.0))
            renewed = problem.value(chi + length * direction, barrier)
        chi, value = chi + length * direction, renewed
    return _Descent(chi, value, most_steps, decrement, False)


class _Problem:
    """Value, gradient and Hessian root of the divergence, the data and the bounds."""

    def __init__(self, prior: CadPrior, coordinates: Coordinates, weight: float, factor: Array | None, bounds: BodyBounds | None) -> None:
        self.prior, self.coordinates, self.factor, self.weight = prior, coordinates, factor, weight
        self.inertial = 10 * prior.n_links
        self.weights = weight * prior.strength
        self.pull = self.weights[:, None] * np.einsum("nij,aji->na", np.linalg.inv(prior.pseudo_inertias), PSEUDO_INERTIA_BASIS)
        self.stiffness = DRIVE_RIDGE / prior.drive_scale**2
        self.rows = np.zeros((0, len(prior.parameters))) if bounds is None else bounds.rows
        self.offsets = np.zeros(0) if bounds is None else bounds.offsets
        self.directions = coordinates.dependent if factor is None else np.hstack([coordinates.kept, coordinates.dependent])

    def bodies(self, chi: Array) -> Array:
        return pseudo_inertias(chi[: self.inertial].reshape(-1, 10))

    def slack(self, chi: Array) -> Array:
        return np.asarray(self.rows @ chi + self.offsets)

    def value(self, chi: Array, barrier: float) -> float:
        try:
            roots = np.linalg.cholesky(self.bodies(chi))
        except np.linalg.LinAlgError:
            return np.inf
        slack = self.slack(chi)
        if np.any(slack <= 0.0):
            return np.inf
        log_det = 2.0 * np.sum(np.log(np.diagonal(roots, axis1=1, axis2=2)), axis=1)
        drives = chi[self.inertial :] - self.prior.parameters[self.inertial :]
        value = np.sum(self.pull.ravel() * chi[: self.inertial]) - self.weights @ log_det
        value += 0.5 * self.stiffness @ drives**2 - barrier * np.sum(np.log(slack))
        if self.factor is not None:
            error = self.factor[:-1, :-1] @ (self.coordinates.regrouping @ chi) - self.factor[:-1, -1]
            value += 0.5 * error @ error
        return float(value)

    def model(self, chi: Array, barrier: float) -> tuple[Array, Array]:
        """Return gradient (v,) and the triangular root of the Hessian (v, v) in the free coordinates."""
        inverse = np.linalg.inv(np.linalg.cholesky(self.bodies(chi)))[:, None]
        whitened = inverse @ PSEUDO_INERTIA_BASIS @ inverse.transpose(0, 1, 3, 2)
        drives = chi[self.inertial :] - self.prior.parameters[self.inertial :]
        slack = self.slack(chi)
        gradient = np.concatenate(
            [(self.pull - self.weights[:, None] * np.trace(whitened, axis1=2, axis2=3)).ravel(), self.stiffness * drives]
        ) - self.rows.T @ (barrier / slack)
        roots = np.sqrt(self.weights)[:, None, None] * svec(whitened).transpose(0, 2, 1)
        free = self.directions
        stack = [
            (roots @ free[: self.inertial].reshape(len(roots), 10, -1)).reshape(self.inertial, -1),
            np.sqrt(self.stiffness)[:, None] * free[self.inertial :],
        ]
        if len(slack):
            stack.append((np.sqrt(barrier) / slack)[:, None] * (self.rows @ free))
        reduced = free.T @ gradient
        if self.factor is not None:
            p = self.coordinates.n_base
            R = self.factor[:-1, :-1]
            reduced[:p] += R.T @ (R @ (self.coordinates.regrouping @ chi) - self.factor[:-1, -1])
            stack.insert(0, np.hstack([R, np.zeros((p, free.shape[1] - p))]))
        triangle, _, _, _ = lapack.dgeqrf(np.asfortranarray(np.vstack(stack)), overwrite_a=True)
        return reduced, np.triu(triangle[: free.shape[1]])

    def room(self, chi: Array, direction: Array) -> float:
        """Return how many steps along a direction lead to the edge: a singular body or a bound."""
        inverse = np.linalg.inv(np.linalg.cholesky(self.bodies(chi)))
        change = np.linalg.eigvalsh(inverse @ self.bodies(direction) @ inverse.transpose(0, 2, 1))
        steepest = max(0.0, -float(change.min()))
        if len(self.rows):
            steepest = max(steepest, float(np.max(-(self.rows @ direction) / self.slack(chi))))
        return 1.0 / steepest if steepest > 0 else np.inf
