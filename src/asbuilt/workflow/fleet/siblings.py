"""The other robots of a type as prior of the next one: empirical Bayes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure, Finding
from asbuilt.identification.errors.error_basis import ErrorBasis
from asbuilt.identification.errors.uncertainty import Uncertainty, block_uncertainty
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.factor_solution import solve_factor
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.identification.result.design_values import design_values
from asbuilt.workflow.fleet.ledger.entry import Entry, joined_entries
from asbuilt.workflow.fleet.ledger.ledger import Ledger

SIBLINGS = "siblings"
"""Name of the method of the estimate."""


@dataclass(frozen=True, slots=True)
class SiblingRules:
    """Hold when siblings inform about a robot."""

    fewest: int = 4
    """Siblings without which there is no spread."""
    unlike: float = 0.01
    """Probability of a difference from the siblings below which their prior is not used."""
    smallest: float = 1e-10
    """Scaled information, relative to the largest, below which a robot's data have none."""
    least_spread: float = 0.05
    """Least variance between robots, in that of their estimates."""
    blocks: int = 24
    """Blocks to which the logs of a sibling are merged."""


RULES = SiblingRules()


@dataclass(frozen=True, slots=True, eq=False)
class SiblingPrior:
    """Hold mean and spread of the robots of a type.

    Parameters
    ----------
    robot_ids
        The siblings.
    mean
        Physically consistent base parameters of all their data together (p,).
    covariance
        Covariance between robots T (p, p), with the error of the mean.
    weights
        Factors of the rows of each joint (n,), median of the siblings.
    design_effect
        Variance of estimates over that of independent samples.
    dispersion
        Mean squared distance of the siblings from the mean, in units of T.
    """

    robot_ids: tuple[str, ...]
    mean: Array
    covariance: Array
    weights: Array
    design_effect: float
    dispersion: float

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the spread."""
        return len(self.robot_ids) - 1


def sibling_prior(ledger: Ledger, robot_id: str, entries: Sequence[Entry]) -> SiblingPrior:
    """Return the prior that the siblings of a robot give, by all their logs.

    Raises
    ------
    IdentifiabilityError
        If there are fewer than four siblings with logs.
    """
    settings, types = entries[0].settings, ledger.types()
    found: dict[str, SquareRootInformation] = {}
    for other in ledger.robot_ids():
        if other == robot_id or not ledger.current_names(other, types=types):
            continue
        logs = [
            each
            for each in ledger.entries(other, types=types)
            if each.settings.digest == settings.digest
        ]
        if logs:
            found[other] = joined_entries(logs, RULES.blocks)
    if len(found) < RULES.fewest:
        raise IdentifiabilityError(
            f"{robot_id} has {len(found)} siblings in the ledger; a prior needs {RULES.fewest}",
            cure=Cure("identify it without a prior, or add logs of its siblings"),
        )
    return prior_of(settings.model, settings.base, found)


def prior_of(
    model: RobotModel, base: BaseParameters, robots: dict[str, SquareRootInformation]
) -> SiblingPrior:
    """Return mean and spread of robots of a type.

    Robot i has `beta_i ~ N(mu, T)` and an estimate with covariance C_i. mu is the physically
    consistent fit to all data. `T + mean C_i` is the covariance of the estimates about mu (method
    of moments: DerSimonian & Laird, Controlled Clinical Trials 7, 1986), shrunk to its diagonal by
    `p / (p + m)` for m robots (Ledoit & Wolf, J. Multivariate Analysis 88, 2004, with a fixed
    intensity), not negative.
    """
    toward = np.nan_to_num(design_values(model, base), nan=0.0)
    parts = list(robots.values())
    together = parts[0].merge(*parts[1:])
    data = EstimationData(model, together, None, toward, "toward_prior")
    mu = methods.find("consistent").estimate(data).beta
    fits = [fit_least_squares(each, weights="joint", prior=mu) for each in parts]
    p, m = len(mu), len(fits)
    effects = [_design_effect(each, fit) for each, fit in zip(parts, fits, strict=True)]
    effect = float(np.median(effects))
    deviations = np.array([fit.beta for fit in fits]) - mu
    S = deviations.T @ deviations / m
    noise = effect * np.mean([fit.covariance for fit in fits], axis=0)
    share = p / (p + m)
    T = S - noise
    T = (1.0 - share) * T + share * np.diag(np.diag(T))
    scale = np.sqrt(np.where(np.diag(S) > 0.0, np.diag(S), 1.0))
    values, axes = np.linalg.eigh(T / np.outer(scale, scale))
    T = (axes * np.maximum(values, RULES.least_spread)) @ axes.T * np.outer(scale, scale)
    T *= 1.0 + 1.0 / m
    weights = np.median([fit.weights for fit in fits], axis=0)
    plain = SiblingPrior(tuple(robots), mu, T, weights, effect, 1.0)
    squares = [_distance(plain, each)[0] for each in parts]
    return SiblingPrior(tuple(robots), mu, T, weights, effect, max(1.0, float(np.mean(squares))))


def estimate_with_siblings(
    robot_id: str, information: SquareRootInformation, prior: SiblingPrior
) -> tuple[Estimate | None, tuple[Finding, ...]]:
    """Return the estimate with the prior, or None and a finding if the robot is unlike them.

    The estimate minimises `sum_k w_k^2 |tau_k - W_k beta|^2 / d + (beta - mu)^T T^-1 (beta - mu)`
    with the design effect d: the posterior mean of normal errors (Efron & Morris, J. Am. Stat.
    Assoc. 68, 1973). Whether data and prior agree is tested first on what the data determine
    better than the prior (Evans & Moshonov, Bayesian Analysis 1, 2006).
    """
    square, r = _distance(prior, information)
    p_value = float(fdtrc(r, max(prior.degrees, 1), square / prior.dispersion)) if r else 1.0
    m = len(prior.robot_ids)
    if p_value < RULES.unlike:
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
    estimate = start.renewed(
        SIBLINGS,
        information,
        solution,
        notes=(note,),
    )
    return estimate, ()


def posterior_uncertainty(
    information: SquareRootInformation, estimate: Estimate, prior: SiblingPrior
) -> Uncertainty:
    """Return the posterior covariance of an estimate with a prior of siblings."""
    return Uncertainty(
        estimate.covariance,
        information.n_samples / prior.design_effect,
        ErrorBasis(kind=SIBLINGS, asked=SIBLINGS, n_blocks=information.n_blocks),
    )


def _distance(prior: SiblingPrior, information: SquareRootInformation) -> tuple[float, int]:
    """Return the mean squared distance from the mean, and the number of directions.

    In prior units, with `L L^T = T` and `L^T A L = U diag(l) U^T`, the data estimate a direction
    with variance 1 / l; beside the prior it is `N(0, 1 + 1 / l)`. Directions with l > 1 count.
    """
    R = information.stacked(prior.weights) / np.sqrt(prior.design_effect)
    L = np.linalg.cholesky(prior.covariance)
    A = R[:-1, :-1] @ L
    error = R[:-1, -1] - R[:-1, :-1] @ prior.mean
    values, axes = np.linalg.eigh(A.T @ A)
    kept = np.flatnonzero(values > max(1.0, RULES.smallest * values[-1]))
    if not kept.size:
        return 0.0, 0
    found = axes[:, kept].T @ (A.T @ error) / values[kept]
    return float(np.mean(found**2 / (1.0 + 1.0 / values[kept]))), len(kept)


def _design_effect(information: SquareRootInformation, fit: Estimate) -> float:
    """Return the variance of estimates by time blocks, over that of independent samples."""
    honest = block_uncertainty(information, fit)
    return float(np.clip(information.n_samples / max(honest.effective_samples, 1.0), 1.0, 100.0))
