"""Physically consistent estimators: least torque error, alone or regularised toward CAD."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from scipy.linalg import lapack, solve_triangular

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.findings import join_names
from asbuilt.identification.bodies.body_bounds import (
    BodyBounds,
    bound_generously,
    bound_with_certainty,
)
from asbuilt.identification.bodies.cad_prior import (
    CadPrior,
    body_metric_root,
    build_cad_prior,
    with_drive_scale,
)
from asbuilt.identification.bodies.conic_fit import TINY_WEIGHT, ConicProblem
from asbuilt.identification.bodies.entropic_fit import Coordinates
from asbuilt.identification.bodies.entropic_path import EntropicPath
from asbuilt.identification.estimators.held_out_choice import choose_weight
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.estimators.methods import JOINT_WEIGHTS, REGULARISATION, estimator
from asbuilt.identification.information.estimate import (
    Estimate,
    EstimationData,
    noise_floor,
    residual_deviation,
)
from asbuilt.identification.information.square_root_information import SquareRootInformation

Metric = Literal["entropic", "euclidean"]

QUIETEST = 1e-5
"""Least noise of a joint in torque RMS; simulations have none, and programs round."""
REWEIGHTINGS = 2
WEAKEST_BELIEF = 1.0
"""Weight of CAD in the standard errors of an estimate that is not regularised toward CAD: links
lie within a factor of about e of CAD.
"""
STRONGEST_BELIEF = 25.0
"""Largest weight of CAD in standard errors: CAD is accurate to a fifth at best."""


@dataclass(frozen=True, slots=True, eq=False)
class ConsistentEstimate(Estimate):
    """Hold an estimate with standard parameters.

    Parameters
    ----------
    standard
        Standard parameters (n_standard,) that give `beta`.
    part
        Largest t such that `P_i >= t P0_i` for every link, P0 being CAD.
    prior_weight
        Cost of a divergence of 1 from CAD in units of the squared weighted residual.
    belief
        The same weight in the standard errors.
    """

    standard: Array = field(default_factory=lambda: np.zeros(0))
    part: float = np.nan
    prior_weight: float = 0.0
    belief: float = 0.0


@estimator(
    "consistent",
    "physically consistent least squares",
    "the best fit of physically consistent links and passive drives, by conic program",
)
def estimate_consistent(data: EstimationData) -> ConsistentEstimate:
    """Estimate the physically consistent parameters of least torque error by a conic program."""
    return fit_consistent(data.information, _build_prior(data))


@estimator(
    "entropic",
    "physically consistent, with an entropic CAD prior",
    "physically consistent links near CAD, the weight of CAD by held-out time blocks",
    held_fixed=(JOINT_WEIGHTS, REGULARISATION),
    regularised=True,
)
def estimate_entropic(data: EstimationData) -> ConsistentEstimate:
    """Estimate with an entropic prior around CAD, its weight chosen by held-out time blocks."""
    return fit_toward_cad(data.information, _build_prior(data), metric="entropic")


@estimator(
    "euclidean",
    "physically consistent, with a quadratic CAD prior",
    "as entropic, with a quadratic distance from CAD",
    held_fixed=(JOINT_WEIGHTS, REGULARISATION),
    regularised=True,
)
def estimate_euclidean(data: EstimationData) -> ConsistentEstimate:
    """Estimate with a quadratic prior around CAD, its weight chosen by held-out time blocks."""
    return fit_toward_cad(data.information, _build_prior(data), metric="euclidean")


def _build_prior(data: EstimationData) -> CadPrior:
    if data.undetermined == "refuse":
        fit_least_squares(data.information, undetermined="refuse")
    return with_drive_scale(build_cad_prior(data.model, data.base.drive), data.information)


@use_one_blas_thread()
def fit_consistent(
    information: SquareRootInformation,
    prior: CadPrior,
    *,
    bounds: BodyBounds | None = None,
    weights: Array | None = None,
) -> ConsistentEstimate:
    """Minimise `sum_k w_k^2 |tau_k - W_k K chi|^2` over physically consistent parameters chi.

    Every link has `P_i >= SMALLEST_PART P0_i`, within `bounds` (`bound_generously` by default).
    Without `weights` they are 1 / sigma_k of a consistent fit, after two iterations. Undetermined
    directions stay next to CAD.
    """
    limits = bound_generously(prior) if bounds is None else bounds
    problem = ConicProblem(prior, information.base.regrouping, limits)
    w, rounds = _fit_joint_weights(information, problem, weights)
    fit = _estimate("consistent", information, prior, w, problem.fit, TINY_WEIGHT, rounds)
    # An interior-point solution comes near its active bounds and never touches them.
    near = np.flatnonzero(limits.slack(fit.standard) <= 1e-6 * (1.0 + np.abs(limits.offsets)))
    active = join_names([limits.labels[j] for j in near], 8) if len(near) else "none"
    note = f"Physically consistent by conic program; active of {len(limits.labels)} bounds: "
    return replace(fit, notes=(f"{note}{active}", *fit.notes))


@use_one_blas_thread()
def fit_toward_cad(
    information: SquareRootInformation,
    prior: CadPrior,
    *,
    metric: Metric = "entropic",
    weight: float | None = None,
    bounds: BodyBounds | None = None,
    weights: Array | None = None,
) -> ConsistentEstimate:
    """Minimise `sum_k w_k^2 |tau_k - W_k K chi|^2 / 2 + weight * distance(chi, CAD)`.

    The minimum is over physically consistent links and passive drives. The distance is the
    divergence of `CadPrior` (`"entropic"`: a smooth problem, own Newton method) or half its
    quadratic form at CAD (`"euclidean"`: a conic program). The entropic minimum is reached through
    minima of larger weights, each from the last, since links may lie far from CAD. `choose_weight`
    chooses a `weight` of None. Drive parameters, for which CAD has no reliable values, are not
    regularised. Raises `UsageError` for another metric.
    """
    if metric not in ("entropic", "euclidean"):
        raise UsageError(f"unknown metric {metric!r}; available: entropic, euclidean")
    base = information.base
    limits = bound_with_certainty(prior)
    limits = limits if bounds is None else limits.and_also(bounds)
    conic = ConicProblem(prior, base.regrouping, limits)
    w, rounds = _fit_joint_weights(information, conic, weights)
    path = EntropicPath(prior, base, limits) if metric == "entropic" else None

    def fit_roughly(factors: Array, weight: float) -> Array:
        if path is not None:
            return path.fit_roughly(factors, weight)
        return np.array([conic.fit(factor, weight, rough=True) for factor in factors])

    reason = "" if weight is None else f"weight of CAD {weight:g}"
    if weight is None:
        choice = choose_weight(information, w, base.regrouping, fit_roughly)
        weight = choice.weight
        reason = choice.reason
    fit = partial(conic.fit if path is None else path.fit_exactly, weight=float(weight))
    return _estimate(metric, information, prior, w, fit, weight, rounds, reason)


def quietest_noise(information: SquareRootInformation) -> Array:
    """Return the least noise (n,): `QUIETEST` of the torque RMS, `noise_floor` of torques of 0.

    It is infinite for joints without torque.
    """
    rms = np.sqrt(information.torque_energy / information.n_samples)
    least = np.where(rms > 0.0, QUIETEST * rms, noise_floor(information))
    # Weights are 1 / noise: infinite noise leaves a joint out.
    return np.where(information.has_torque, least, np.inf)


def _fit_joint_weights(
    information: SquareRootInformation, problem: ConicProblem, weights: Array | None
) -> tuple[Array, int]:
    """Return weights per joint, 1 / sigma_k of a consistent fit, and how many rounds it took."""
    if weights is not None:
        return np.where(information.has_torque, weights, 0.0), 0
    quietest = quietest_noise(information)
    base = information.base
    # Only the residuals count here, so that undetermined directions may have any value.
    free = fit_least_squares(information, weights="joint", prior=np.zeros(base.n_base))
    w = 1.0 / np.maximum(free.sigma, quietest)
    for _ in range(REWEIGHTINGS):
        energy = information.residual_energy(base.regrouping @ problem.fit(information.stacked(w)))
        w = 1.0 / np.maximum(np.sqrt(energy / information.n_samples), quietest)
    return w, REWEIGHTINGS


def _estimate(
    method: str,
    information: SquareRootInformation,
    prior: CadPrior,
    weights: Array,
    fit: Callable[[Array], Array],
    prior_weight: float,
    rounds: int,
    *notes: str,
) -> ConsistentEstimate:
    """Return the estimate with its errors, `fit` giving chi for a factor of weighted rows.

    The errors follow from the normal approximation to the posterior, `K H^-1 K^T` with H the
    information of the data plus `belief` times the metric halfway between CAD and estimate. The
    belief is the smallest of 25, the weight used (1 without regularisation), and the weight that
    the distance from CAD supports (as many determined parameters as twice the divergence times the
    weight: MacKay, Neural Computation 4, 1992). Active bounds are not taken as known, so these
    errors are rather too large than too small.
    """
    base = information.base
    free = fit_least_squares(information, weights=weights, prior=base.regrouping @ prior.parameters)
    factor = information.stacked(weights)
    chi = fit(factor)
    # A tiny weight only holds undetermined directions: their errors need CAD's weakest belief.
    beta = base.regrouping @ chi
    belief, root = _estimate_belief_and_root(
        information,
        prior,
        weights,
        chi,
        WEAKEST_BELIEF if prior_weight <= TINY_WEIGHT else prior_weight,
    )
    error = factor @ np.append(-beta, 1.0)
    energy = float(error @ error)
    part = float(prior.relative_eigenvalues(chi).min())
    known = "CAD" if np.any(prior.strength == 1.0) else "the bodies assumed"
    return ConsistentEstimate(
        method=method,
        # Weights are 1 / sigma, so that the ratio is 1 where they are right; errors are not shrunk
        # below.
        beta=beta,
        covariance=max(energy / max(information.n_rows - free.rank, 1), 1.0) * root @ root.T,
        sigma=residual_deviation(information, beta, root, weights),
        weights=weights,
        solution=replace(free.solution, x=beta, inverse_root=root, residual_energy=energy),
        undetermined=free.undetermined,
        determined=free.determined,
        iterations=rounds,
        converged=True,
        notes=(
            *notes,
            f"Every link is physically consistent, its pseudo-inertia at least {part:.2g} of"
            f" {known}",
            f"Standard errors use {known} with weight {belief:.3g}",
            *prior.notes,
        ),
        refit=lambda factor: base.regrouping @ fit(factor),
        standard=chi,
        part=part,
        prior_weight=prior_weight,
        belief=belief,
    )


def _weigh_known_masses(prior: CadPrior) -> Array:
    """Return rows (k, n_standard) over standard deviations of masses known within two limits."""
    known = [limits for limits in prior.mass_ranges if np.isfinite(limits[2])]
    rows = np.zeros((len(known), len(prior.parameters)))
    for row, (links, lower, upper) in zip(rows, known, strict=True):
        # Standard deviation of a uniform distribution between limits: their distance over sqrt(12).
        row[[10 * link + 9 for link in links]] = np.sqrt(12.0) / (upper - lower)
    return rows


def choose_cad_weight(
    information: SquareRootInformation, prior: CadPrior, weights: Array, chi: Array, weight: float
) -> float:
    """Return the weight of CAD that the distance of a fit from CAD supports.

    As many determined parameters as twice the divergence times the weight: the estimate of the
    precision of a prior by MacKay, Neural Computation 4, 1992. `chi` is the fit with `weight`.
    """
    return _estimate_weight(*_stack_rows(information, prior, weights, chi), prior, chi, weight)


def _stack_rows(
    information: SquareRootInformation, prior: CadPrior, weights: Array, chi: Array
) -> tuple[Array, Array, Array]:
    """Return rows of the data, of CAD with unit weight, and of drives and known masses."""
    coordinates = Coordinates.of(information.base)
    free = np.hstack([coordinates.kept, coordinates.dependent])
    inertial = 10 * prior.n_links
    # Halfway between CAD and estimate, where the quadratic form is nearest to the divergence.
    halfway = 0.5 * (prior.parameters[:inertial] + chi[:inertial])
    roots = body_metric_root(halfway, prior.strength)
    bodies = (roots @ free[:inertial].reshape(prior.n_links, 10, -1)).reshape(inertial, -1)
    drives = np.sqrt(prior.drive_weight) / prior.drive_scale[:, None] * free[inertial:]
    known = _weigh_known_masses(prior) @ free
    R = information.stacked(weights)[:-1, :-1]
    return (
        np.hstack([R, np.zeros((len(R), free.shape[1] - len(R)))]),
        bodies,
        np.vstack([drives, known]),
    )


def _invert_root(data: Array, bodies: Array, others: Array, belief: float) -> Array:
    """Return the inverse of the triangular root of the information."""
    # QR of the stacked rows: the information itself would square their condition.
    triangle, _, _, _ = lapack.dgeqrf(
        np.asfortranarray(np.vstack([data, np.sqrt(belief) * bodies, others])), overwrite_a=True
    )
    p = data.shape[1]
    return np.asarray(solve_triangular(np.triu(triangle[:p]), np.eye(p)))


def _estimate_weight(
    data: Array, bodies: Array, others: Array, prior: CadPrior, chi: Array, weight: float
) -> float:
    """Return the weight of CAD that the distance of `chi` supports."""
    # |pulled|^2 = tr(weight M H^-1): the parameters that CAD rather than the data determines.
    pulled = np.sqrt(weight) * bodies @ _invert_root(data, bodies, others, weight)
    determined = len(bodies) - float(np.sum(pulled**2))
    moved = 2.0 * float(prior.strength @ prior.divergence(chi))
    return max(determined, 1.0) / max(moved, float(np.finfo(np.float64).tiny))


def _estimate_belief_and_root(
    information: SquareRootInformation, prior: CadPrior, weights: Array, chi: Array, weight: float
) -> tuple[float, Array]:
    """Return the belief in CAD and the root (p, p) of the covariance of beta."""
    data, bodies, others = _stack_rows(information, prior, weights, chi)
    belief = min(
        weight, STRONGEST_BELIEF, _estimate_weight(data, bodies, others, prior, chi, weight)
    )
    wide = _invert_root(data, bodies, others, belief)[: information.base.n_base]
    # A second QR makes the root of beta's covariance square.
    triangle, _, _, _ = lapack.dgeqrf(np.asfortranarray(wide.T), overwrite_a=True)
    return belief, np.asarray(np.triu(triangle[: len(wide)]).T)
