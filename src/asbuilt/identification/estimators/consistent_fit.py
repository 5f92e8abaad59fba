"""Estimators whose every link is a real body: least torque error alone, or with a pull to CAD."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.linalg import lapack, solve_triangular

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.identification.bodies.body_bounds import (
    BodyBounds,
    generous_bounds,
    non_negative_drives,
)
from asbuilt.identification.bodies.cad_prior import CadPrior, body_metric_root, cad_prior
from asbuilt.identification.bodies.conic_fit import TINY_WEIGHT, ConicProblem, fit_consistent_bodies
from asbuilt.identification.bodies.entropic_fit import (
    DRIVE_RIDGE,
    Coordinates,
    EntropicFits,
    EntropicProblem,
)
from asbuilt.identification.estimators.least_squares import (
    Estimate,
    FactorSolution,
    Refit,
    fit_least_squares,
    noise_floor,
)
from asbuilt.identification.estimators.methods import JOINT_WEIGHTS, REGULARISATION, estimator
from asbuilt.identification.estimators.prior_weight import WEIGHTS, choose_weight
from asbuilt.identification.information.square_root_information import SquareRootInformation

if TYPE_CHECKING:
    from asbuilt.identification.information.estimation_data import EstimationData

Metric = Literal["entropic", "euclidean"]

QUIETEST = 1e-5
"""Noise of a joint, as a fraction of its torque RMS, below which its weight grows no further.

Simulations have none, and programs round.
"""
REWEIGHTINGS = 2
ROUGH = 1e-3
"""Squared distance from the minimum, in squared standard errors or so, at which fits that only
choose the weight of CAD end.
"""
START_SLACK = 0.1
"""Where bounded drive parameters start, in units of their scale."""
WEAKEST_BELIEF = 1.0
"""Weight of CAD in the errors of an estimate that does not lean on it.

Every body is known to lie within a factor of e or so of its CAD.
"""
STRONGEST_BELIEF = 25.0
"""In the errors, no CAD is believed to better than a fifth."""


@dataclass(frozen=True, slots=True, eq=False)
class ConsistentEstimate(Estimate):
    """Hold an estimate with bodies behind it.

    `standard` (n_standard,) gives `beta`, with `P_i >= part P0_i > 0` for every link.

    `prior_weight` is what a divergence of 1 from CAD costs in units of the squared weighted
    residual, `belief` the weight that the errors were judged with.
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
    """Estimate the real bodies and passive drives that fit best.

    The conic program, with the tiniest pull to CAD.
    """
    return fit_consistent(data.information, _prior(data))


@estimator(
    "entropic",
    "physically consistent, with an entropic CAD prior",
    "physically consistent links near CAD, the weight of CAD by held-out time blocks",
    held_fixed=(JOINT_WEIGHTS, REGULARISATION),
    regularised=True,
)
def estimate_entropic(data: EstimationData) -> ConsistentEstimate:
    """Estimate with an entropic prior around CAD, its weight chosen by held-out time blocks."""
    return fit_toward_cad(data.information, _prior(data), metric="entropic")


@estimator(
    "euclidean",
    "physically consistent, with a quadratic CAD prior",
    "as entropic, with a quadratic distance from CAD",
    held_fixed=(JOINT_WEIGHTS, REGULARISATION),
    regularised=True,
)
def estimate_euclidean(data: EstimationData) -> ConsistentEstimate:
    """Estimate with a quadratic prior around CAD, its weight chosen by held-out time blocks."""
    return fit_toward_cad(data.information, _prior(data), metric="euclidean")


def _prior(data: EstimationData) -> CadPrior:
    if data.undetermined == "refuse":
        fit_least_squares(data.information, undetermined="refuse")
    return cad_prior(data.model, data.base.drive)


def fit_consistent(
    information: SquareRootInformation,
    prior: CadPrior,
    *,
    bounds: BodyBounds | None = None,
    weights: Array | None = None,
) -> ConsistentEstimate:
    """Estimate by `min sum_k w_k^2 |tau_k - W_k K chi|^2` over real bodies.

    `P_i >= SMALLEST_PART P0_i`, within `bounds` (`generous_bounds` by default).

    Without `weights` they are 1 / sigma_k of a consistent fit, settled in two rounds. What the
    torques leave open lies next to CAD.
    """
    limits = generous_bounds(prior) if bounds is None else bounds
    with one_blas_thread():
        problem = ConicProblem.of(prior, information.base.regrouping, limits)
        w, rounds = _joint_weights(information, problem, weights)
        fit = problem.fit(information.stacked(w))
        near = np.flatnonzero(limits.slack(fit.chi) <= 1e-6 * (1.0 + np.abs(limits.offsets)))
        notes = (
            (
                f"real bodies and passive drives, by conic program: {len(limits.labels)} bounds, of"
                " which active: "
                f"{', '.join(limits.labels[j] for j in near[:8]) or 'none'}{f' and {len(near) - 8} more' if len(near) > 8 else ''}"
            ),
        )
        return _estimate(
            "consistent",
            information,
            prior,
            w,
            fit.chi,
            TINY_WEIGHT,
            rounds,
            notes,
            lambda factor: problem.fit(factor).chi,
        )


def fit_toward_cad(
    information: SquareRootInformation,
    prior: CadPrior,
    *,
    metric: Metric = "entropic",
    weight: float | None = None,
    bounds: BodyBounds | None = None,
    weights: Array | None = None,
) -> ConsistentEstimate:
    """Estimate by `min sum_k w_k^2 |tau_k - W_k K chi|^2 / 2 + weight * distance(chi, CAD)` over
    real bodies and passive drives.

    The distance is the divergence of `CadPrior` (`"entropic"`: a smooth problem, own Newton method)
    or half its quadratic form at CAD (`"euclidean"`: a conic program). The entropic minimum is
    reached through those of stronger pulls, each from the last, for bodies may lie far from CAD.
    `weight` None is chosen by `choose_weight`. Drive parameters, on which CAD knows next to
    nothing, are not pulled. Raises `UsageError` for another metric.
    """
    if metric not in ("entropic", "euclidean"):
        raise UsageError(f"there is no metric {metric!r}; there are entropic and euclidean")
    base = information.base
    limits = (
        non_negative_drives(prior)
        if bounds is None
        else non_negative_drives(prior).and_also(bounds)
    )

    with one_blas_thread():
        conic = ConicProblem.of(prior, base.regrouping, limits)
        w, rounds = _joint_weights(information, conic, weights)
        path = _EntropicPath(
            EntropicProblem(prior, Coordinates.of(base), limits), _inside(prior, limits)
        )

        def roughly(factors: Array, weight: float) -> Array:
            return (
                path.roughly(factors, weight)
                if metric == "entropic"
                else np.array([conic.fit(factor, weight, rough=True).chi for factor in factors])
            )

        def exactly(factor: Array) -> Array:
            return (
                path.exactly(factor, pull) if metric == "entropic" else conic.fit(factor, pull).chi
            )

        if weight is None:
            choice = choose_weight(information, w, base.regrouping, roughly)
            pull, reason = choice.weight, choice.reason
        else:
            pull, reason = float(weight), f"weight of CAD {weight:g}, as given"
        return _estimate(
            metric,
            information,
            prior,
            w,
            exactly(information.stacked(w)),
            pull,
            rounds,
            (reason,),
            exactly,
        )


class _EntropicPath:
    """Fits from the strongest weight to weaker ones, each from the one before."""

    def __init__(self, problem: EntropicProblem, start: Array) -> None:
        self._problem, self._start = problem, start
        self._reached: dict[float, EntropicFits] = {}

    def roughly(self, factors: Array, weight: float) -> Array:
        """Return the fits of many factors, to a small part of a standard error, from those of the
        same factors with the last weight.
        """
        stronger = [self._reached[other] for other in self._reached if other > weight]
        start = stronger[-1] if stronger else np.tile(self._start, (len(factors), 1))
        self._reached[weight] = self._problem.fit(factors, weight, start, close=ROUGH)
        return self._reached[weight].chi

    def exactly(self, factor: Array, weight: float) -> Array:
        """Return the fit of one factor, from that of the last of the factors fitted with this
        weight, or through stronger weights.
        """
        if weight not in self._reached:
            self._reached.clear()
            for each in (*(stronger for stronger in WEIGHTS if stronger > weight), weight):
                self.roughly(factor[None], each)
        return np.asarray(
            self._problem.fit(factor[None], weight, self._reached[weight].alone(-1)).chi[0]
        )


def _inside(prior: CadPrior, bounds: BodyBounds) -> Array:
    """Return parameters strictly inside: CAD, its bounded drives off zero.

    Nearest to it with room to spare where bounds exclude it.
    """
    chi = prior.parameters.copy()
    lifted = prior.non_negative
    chi[lifted] = np.maximum(
        chi[lifted], START_SLACK * prior.drive_scale[lifted - 10 * prior.n_links]
    )
    if np.all(bounds.slack(chi) > 0):
        return chi
    room = 1e-3 * np.linalg.norm(bounds.rows, axis=1)
    tighter = BodyBounds(bounds.rows, bounds.offsets - room, bounds.labels)
    p = len(prior.parameters)
    nothing = np.zeros((p + 1, p + 1))
    return fit_consistent_bodies(
        prior, np.eye(p), factor=nothing, bounds=tighter, weight=1.0, smallest_part=1e-2
    ).chi


def quietest_noise(information: SquareRootInformation) -> Array:
    """Return the noise (n,) below which that of no joint is taken.

    `QUIETEST` of its torque RMS, `noise_floor` where it has no torque.
    """
    rms = np.sqrt(information.torque_energy / information.n_samples)
    return np.where(rms > 0.0, QUIETEST * rms, noise_floor(information))


def _joint_weights(
    information: SquareRootInformation, problem: ConicProblem, weights: Array | None
) -> tuple[Array, int]:
    """Return weights per joint, 1 / sigma_k of a consistent fit, and how many rounds it took."""
    if weights is not None:
        return (
            fit_least_squares(
                information, weights=weights, prior=np.zeros(information.base.n_base)
            ).weights,
            0,
        )
    quietest = quietest_noise(information)
    w = 1.0 / np.maximum(
        fit_least_squares(
            information, weights="joint", prior=np.zeros(information.base.n_base)
        ).sigma,
        quietest,
    )
    for _ in range(REWEIGHTINGS):
        chi = problem.fit(information.stacked(w)).chi
        w = 1.0 / np.maximum(
            np.sqrt(
                information.residual_energy(information.base.regrouping @ chi)
                / information.n_samples
            ),
            quietest,
        )
    return w, REWEIGHTINGS


def _estimate(
    method: str,
    information: SquareRootInformation,
    prior: CadPrior,
    weights: Array,
    chi: Array,
    prior_weight: float,
    rounds: int,
    notes: tuple[str, ...],
    again: Refit,
) -> ConsistentEstimate:
    """Return the estimate with its errors.

    The errors are those of the normal approximation to the posterior, `K H^-1 K^T` with H the
    information of the data plus `belief` times the metric of the bodies halfway between CAD and
    estimate. The belief is the smallest of the weight used, of 25, of the weight that the distance
    of the found bodies from CAD bears out (as many determined parameters as twice the divergence
    times the weight: MacKay, Neural Computation 4, 1992), and, where the fit does not lean on CAD,
    of 1. Active bounds are not taken as known, so these errors are rather too large than too small.
    """
    base = information.base
    free = fit_least_squares(information, weights=weights, prior=base.regrouping @ prior.parameters)
    beta = base.regrouping @ chi
    belief, root = _belief_and_root(
        information,
        prior,
        weights,
        chi,
        WEAKEST_BELIEF if prior_weight <= TINY_WEIGHT else prior_weight,
    )
    n_rows = information.n_samples * information.n_joints
    factor = information.stacked(weights)
    error = factor @ np.append(-beta, 1.0)
    energy = float(error @ error)
    solution: FactorSolution = replace(
        free.solution, x=beta, inverse_root=root, residual_energy=energy
    )
    spent = np.array(
        [
            float(np.sum((w * R[:-1, :-1] @ root[support]) ** 2))
            for support, R, w in zip(
                information.support, information.joint_factors, weights, strict=True
            )
        ]
    )
    sigma = np.sqrt(
        information.residual_energy(beta) / np.maximum(information.n_samples - spent, 1.0)
    )
    part = float(prior.relative_eigenvalues(chi).min())
    return ConsistentEstimate(
        method=method,
        beta=beta,
        covariance=max(energy / max(n_rows - free.rank, 1), 1.0) * root @ root.T,
        sigma=sigma,
        weights=weights,
        solution=solution,
        undetermined=free.undetermined,
        determined=free.determined,
        iterations=rounds,
        converged=True,
        notes=(
            *notes,
            f"every link is a real body: its pseudo-inertia is at least {part:.2g} of that of CAD",
            f"standard errors believe CAD with weight {belief:.3g}",
            *prior.notes,
        ),
        refit=lambda factor: base.regrouping @ again(factor),
        standard=chi,
        part=part,
        prior_weight=prior_weight,
        belief=belief,
    )


def _belief_and_root(
    information: SquareRootInformation, prior: CadPrior, weights: Array, chi: Array, weight: float
) -> tuple[float, Array]:
    """Return the belief in CAD and the root (p, p) of the covariance of beta."""
    coordinates = Coordinates.of(information.base)
    free = np.hstack([coordinates.kept, coordinates.dependent])
    inertial = 10 * prior.n_links
    halfway = 0.5 * (prior.parameters[:inertial] + chi[:inertial])
    roots = body_metric_root(halfway, prior.strength)
    bodies = (roots @ free[:inertial].reshape(prior.n_links, 10, -1)).reshape(inertial, -1)
    drives = np.sqrt(DRIVE_RIDGE) / prior.drive_scale[:, None] * free[inertial:]
    R = information.stacked(weights)[:-1, :-1]
    data = np.hstack([R, np.zeros((len(R), free.shape[1] - len(R)))])

    def inverse_root(belief: float) -> Array:
        triangle, _, _, _ = lapack.dgeqrf(
            np.asfortranarray(np.vstack([data, np.sqrt(belief) * bodies, drives])), overwrite_a=True
        )
        return np.asarray(
            solve_triangular(np.triu(triangle[: free.shape[1]]), np.eye(free.shape[1]))
        )

    told = inertial - float(np.sum((np.sqrt(weight) * bodies @ inverse_root(weight)) ** 2))
    moved = float(prior.strength @ prior.divergence(chi))
    belief = min(
        weight, STRONGEST_BELIEF, max(told, 1.0) / max(2.0 * moved, np.finfo(np.float64).tiny)
    )
    p = len(R)
    wide = inverse_root(belief)[:p]
    triangle, _, _, _ = lapack.dgeqrf(np.asfortranarray(wide.T), overwrite_a=True)
    return belief, np.asarray(np.triu(triangle[:p]).T)
