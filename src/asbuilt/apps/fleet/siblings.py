"""The other robots of a type as prior of the next one: empirical Bayes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from asbuilt.apps.fleet.ledger.entry import Entry, join_entries
from asbuilt.apps.fleet.ledger.ledger import Ledger
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.dynamics import BaseParameters
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure, Finding
from asbuilt.identification import (
    ErrorBasis,
    Estimate,
    EstimationData,
    SquareRootInformation,
    Uncertainty,
    design_values,
    estimate_block_uncertainty,
    fit_least_squares,
    methods,
    solve_factor,
    triangular_factor,
    widening,
)
from asbuilt.scaled import Scaled

SIBLINGS = "siblings"
"""Name of the method of the estimate."""


# Hold when siblings inform about a robot.

SIBLING_FEWEST = 4  # Siblings without which there is no spread
# Probability of a difference from the siblings below which their prior is not used
SIBLING_UNLIKE = 0.01
# Scaled information, relative to the largest, below which a robot's data have none
SIBLING_SMALLEST = 1e-10
# Turns of mean and spread; the second changes the mean by a hundredth of the spread
SIBLING_PASSES = 3
SIBLING_BLOCKS = 24  # Blocks to which the logs of a sibling are merged


@dataclass(frozen=True, slots=True, eq=False)
class SiblingPrior:
    """Hold mean and spread of the robots of a type.

    Parameters
    ----------
    robot_ids
        The siblings.
    mean
        Their physically consistent mean (p,).
    covariance
        Covariance between robots T (p, p), with the error of the mean and of itself.
    weights
        Factors of the rows of each joint (n,), median of the siblings.
    design_effect
        Variance of estimates over their variance for independent samples.
    dispersion
        Mean squared distance of the siblings from the mean, in units of T.
    """

    robot_ids: tuple[str, ...]
    mean: Array
    covariance: Array
    weights: Array
    design_effect: float
    dispersion: float


def build_sibling_prior(ledger: Ledger, robot_id: str, entries: Sequence[Entry]) -> SiblingPrior:
    """Return the prior that the siblings of a robot give, by all their logs.

    Raises
    ------
    IdentifiabilityError
        If there are fewer than four siblings with logs.
    """
    settings = entries[0].settings
    types = ledger.types()
    found: dict[str, SquareRootInformation] = {}
    for other in (each for each in ledger.robot_ids() if each != robot_id):
        logs = [
            entry
            for entry in ledger.entries(other, types=types)
            if entry.settings.digest == settings.digest
        ]
        if logs:
            found[other] = join_entries(logs, SIBLING_BLOCKS)
    if len(found) < SIBLING_FEWEST:
        raise IdentifiabilityError(
            f"{robot_id} has {len(found)} siblings in the ledger; a prior needs {SIBLING_FEWEST}",
            cure=Cure("identify it without a prior, or add logs of its siblings"),
        )
    return estimate_prior(settings.model, settings.base, found)


def estimate_prior(
    model: RobotModel, base: BaseParameters, robots: dict[str, SquareRootInformation]
) -> SiblingPrior:
    """Return mean and spread of robots of a type.

    Robot i has `beta_i ~ N(mu, T)` and an estimate b_i with covariance C_i, so that
    `b_i ~ N(mu, T + C_i)`. mu is the physically consistent fit to the b_i with these covariances
    (random effects: DerSimonian & Laird, Controlled Clinical Trials 7, 1986); the fit to all data
    together is none, since what differs between robots would leak into what does not. T follows
    from the b_i about mu as in `_estimate_spread`. A new robot lies in a Student distribution about
    mu: T is widened by its quantile, and by the error of mu.
    """
    toward = np.nan_to_num(design_values(model, base), nan=0.0)
    parts = list(robots.values())
    data = EstimationData(model, parts[0].merge(*parts[1:]), None, toward, "toward_prior")
    pooled = methods.find("consistent").estimate(data)
    fits = [fit_least_squares(part, weights="joint", prior=pooled.beta) for part in parts]
    effect = float(
        np.median(
            [_estimate_design_effect(part, fit) for part, fit in zip(parts, fits, strict=True)]
        )
    )
    noise = effect * np.mean([fit.covariance for fit in fits], axis=0)
    estimates = np.array([fit.beta for fit in fits])
    m = len(fits)
    rows = [part.stacked(fit.weights) / np.sqrt(effect)
            for part, fit in zip(parts, fits, strict=True)]  # fmt: skip
    mu = estimates.mean(axis=0)
    for _ in range(SIBLING_PASSES):
        mu = _fit_mean(pooled, rows, _estimate_spread(estimates - mu, noise))
    T = _estimate_spread(estimates - mu, noise)
    T *= (1.0 + 1.0 / m) * float(widening(np.array(m - 1.0))) ** 2
    weights = np.median([fit.weights for fit in fits], axis=0)
    plain = SiblingPrior(tuple(robots), mu, T, weights, effect, 1.0)
    squares = [_measure_distance(plain, part)[0] for part in parts]
    return SiblingPrior(tuple(robots), mu, T, weights, effect, max(1.0, float(np.mean(squares))))


def _estimate_spread(deviations: Array, noise: Array) -> Array:
    """Return the covariance between robots T (p, p) from estimates about their mean (m, p).

    The covariance S of the estimates, less the covariance of their noise, is shrunk to its diagonal
    by `p / (p + m)` (Ledoit & Wolf, J. Multivariate Analysis 88, 2004, with a fixed intensity).
    m robots determine a variance to `sqrt(2 / (m - 1))` of itself: T is at least that share of S in
    every direction, since a smaller one cannot be distinguished from zero, and would be trusted.
    """
    m, p = deviations.shape
    S = deviations.T @ deviations / (m - 1)
    share = p / (p + m)
    T = (1.0 - share) * (S - noise) + share * np.diag(np.diag(S - noise))
    scale = np.sqrt(np.where(np.diag(S) > 0.0, np.diag(S), 1.0))
    values, axes = np.linalg.eigh(T / np.outer(scale, scale))
    raised = np.maximum(values, np.sqrt(2.0 / (m - 1)))
    return np.asarray((axes * raised) @ axes.T * np.outer(scale, scale))


def _fit_mean(pooled: Estimate, rows: Sequence[Array], T: Array) -> Array:
    """Return the physically consistent mean of robots with the spread T.

    Each has the rows `[R z]` of its data, so that `A = R^T R` is the inverse of C_i, and the
    inverse of `T + C_i` is `A - A (A + T^-1)^-1 A`, whatever its data leave undetermined.
    """
    inverse = np.linalg.inv(T)
    K = np.zeros_like(T)
    k = np.zeros(len(T))
    for row in rows:
        A = row[:-1, :-1].T @ row[:-1, :-1]
        a = row[:-1, :-1].T @ row[:-1, -1]
        kept = np.linalg.solve(A + inverse, inverse)  # what the spread leaves of the data
        K += A @ kept
        k += kept.T @ a
    own = Scaled(K)
    none = np.zeros((1, len(T) + 1))
    assert pooled.refit is not None  # the consistent fit is not linear in the torque
    both = np.column_stack([own.root, own.whiten(k)])
    return pooled.refit(triangular_factor(np.vstack([both, none])))


def estimate_with_siblings(
    robot_id: str, information: SquareRootInformation, prior: SiblingPrior
) -> tuple[Estimate | None, tuple[Finding, ...]]:
    """Return the estimate with the prior, or None and a finding if the robot is unlike them.

    The estimate minimises `sum_k w_k^2 |tau_k - W_k beta|^2 / d + (beta - mu)^T T^-1 (beta - mu)`
    with the design effect d: the posterior mean of normal errors (Efron & Morris, J. Am. Stat.
    Assoc. 68, 1973). Whether data and prior agree is tested first on what the data determine
    better than the prior (Evans & Moshonov, Bayesian Analysis 1, 2006).
    """
    m, (square, r) = len(prior.robot_ids), _measure_distance(prior, information)
    p_value = float(fdtrc(r, max(m - 1, 1), square / prior.dispersion)) if r else 1.0
    if p_value < SIBLING_UNLIKE:
        return None, (
            Finding(
                "unlike_siblings",
                "warning",
                f"{robot_id} differs from its {m} siblings by {np.sqrt(square):.2g} times their"
                f" spread (p {p_value:.1g}); they are not used as its prior",
                Cure("look for a tool, a repair or another type of robot", call="fleet_drift"),
            ),
        )
    start = fit_least_squares(information, weights=prior.weights, prior=prior.mean)
    root = np.linalg.inv(np.linalg.cholesky(prior.covariance))
    rows = information.stacked(prior.weights) / np.sqrt(prior.design_effect)
    factor = triangular_factor(np.vstack([rows, np.column_stack([root, root @ prior.mean])]))
    solution = solve_factor(
        factor, information.n_samples * information.n_joints + len(root), prior.mean
    )
    note = f"Mean and spread of {m} siblings are the prior (p {p_value:.2g} that it fits)."
    return start.renewed(SIBLINGS, information, solution, notes=(note,)), ()


def derive_posterior_uncertainty(
    information: SquareRootInformation, estimate: Estimate, prior: SiblingPrior
) -> Uncertainty:
    """Return the posterior covariance of an estimate with a prior of siblings."""
    return Uncertainty(
        estimate.covariance,
        information.n_samples / prior.design_effect,
        ErrorBasis(kind=SIBLINGS, asked=SIBLINGS, n_blocks=information.n_blocks),
    )


def _measure_distance(prior: SiblingPrior, information: SquareRootInformation) -> tuple[float, int]:
    """Return the mean squared distance from the mean, and the number of directions.

    In prior units, with `L L^T = T` and `L^T A L = U diag(l) U^T`, the data estimate a direction
    with variance 1 / l; about the prior mean it is `N(0, 1 + 1 / l)`. Directions with l > 1 count.
    """
    R = information.stacked(prior.weights) / np.sqrt(prior.design_effect)
    L = np.linalg.cholesky(prior.covariance)
    A = R[:-1, :-1] @ L
    error = R[:-1, -1] - R[:-1, :-1] @ prior.mean
    values, axes = np.linalg.eigh(A.T @ A)
    kept = np.flatnonzero(values > max(1.0, SIBLING_SMALLEST * values[-1]))
    if not kept.size:
        return 0.0, 0
    found = axes[:, kept].T @ (A.T @ error) / values[kept]
    return float(np.mean(found**2 / (1.0 + 1.0 / values[kept]))), len(kept)


def _estimate_design_effect(information: SquareRootInformation, fit: Estimate) -> float:
    """Return the variance of estimates by time blocks, over its value for independent samples."""
    honest = estimate_block_uncertainty(information, fit)
    return float(np.clip(information.n_samples / max(honest.effective_samples, 1.0), 1.0, 100.0))
