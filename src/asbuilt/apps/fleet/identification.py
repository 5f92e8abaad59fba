"""Identification of a robot of a fleet from its ledger, with its type's other robots as prior."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.special import fdtrc

from asbuilt.apps.fleet.ledger.entry import Entry, join_entries
from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.options import FleetIdentification
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.dynamics import BaseParameters
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.identification import (
    ErrorBasis,
    Estimate,
    EstimationData,
    IdentificationResult,
    SquareRootInformation,
    Uncertainty,
    conclude,
    design_values,
    estimate_block_uncertainty,
    fit_least_squares,
    methods,
    solve_factor,
    triangular_factor,
    widening,
)
from asbuilt.scaled import Scaled
from asbuilt.workflow import Study

MOST_BLOCKS = 96
"""Time blocks of all logs together; more are merged with their neighbours. Standard errors need
some dozens, and take a millisecond each."""


def fleet_identify(
    ledger: Ledger | str | Path,
    robot_id: str,
    *,
    since: datetime | None = None,
    until: datetime | None = None,
    options: FleetIdentification | None = None,
) -> Study:
    """Identify a robot from the ledger alone, in milliseconds.

    `identify` gives the same parameters, to rounding, on the same logs with the same method, signal
    chain and drive terms. Standard errors agree too if the logs are 80 s or shorter; longer ones
    have 16 time blocks each in the ledger.

    Parameters
    ----------
    ledger
        A ledger, its folder or URL.
    robot_id
        Identity of the robot.
    since, until
        Logs with `since <= date < until` count; None: all.
    options
        How to identify.

    Returns
    -------
    Study
        The result with findings; it has no predictions, since a ledger has no samples.

    Raises
    ------
    UsageError
        If there is no ledger or no such robot.
    IdentifiabilityError
        If it has no sound log in these dates, or the logs do not suffice.
    """
    opened = open_ledger(ledger)
    entries = opened.entries(robot_id, since, until)
    if not entries:
        raise _make_missing_error(opened, robot_id, since, until)
    chosen = options or FleetIdentification()
    prior = build_sibling_prior(opened, robot_id, entries) if chosen.prior == "siblings" else None
    result = identify_entries(entries, chosen, prior)
    findings = [*result.findings, *opened.findings, *_report_logs(entries)]
    return Study(result, rank_findings(findings))


def identify_entries(
    entries: Sequence[Entry],
    options: FleetIdentification,
    prior: SiblingPrior | None = None,
) -> IdentificationResult:
    """Identify a robot from entries of one type, with a prior of its siblings if there is one.

    Raises
    ------
    IdentifiabilityError
        If the entries are of two types, or do not suffice.
    """
    first = entries[0]
    last = entries[-1]
    settings = first.settings
    odd = next((entry for entry in entries if entry.settings.digest != settings.digest), None)
    if odd is not None:
        raise IdentifiabilityError(
            f"{odd.robot_id} has logs of two types of robot: {settings.robot_type} and"
            f" {odd.settings.robot_type}",
            cure=Cure("give each robot an identity of its own, or choose dates of one of them"),
        )
    information = join_entries(entries, MOST_BLOCKS)
    design = design_values(settings.model, settings.base)
    data = EstimationData(settings.model, information, None, design, options.undetermined)
    estimate = uncertainty = None
    findings = tuple[Finding, ...]()
    if prior is not None:
        estimate, findings = estimate_with_siblings(first.robot_id, information, prior)
        if estimate is not None:
            uncertainty = derive_posterior_uncertainty(information, estimate, prior)
    if estimate is None or uncertainty is None:
        estimate = methods.find(options.method).estimate(data)
        uncertainty = estimate_block_uncertainty(estimate.information or information, estimate)
    return conclude(
        settings.model,
        information,
        estimate,
        rate=first.rate,
        uncertainty=uncertainty,
        provenance=(
            f"{len(entries)} logs of {first.robot_id} from {first.date:%Y-%m-%d} to"
            f" {last.date:%Y-%m-%d}, kept as information in a ledger",
            *settings.chosen,
        ),
        chain=settings.chain,
        findings=findings,
        digests=tuple(entry.source_sha256[:16] for entry in entries),
    )


def _report_logs(entries: Sequence[Entry]) -> list[Finding]:
    """Return a finding for each kind of warning of the logs, with their number."""
    counts = Counter(code for entry in entries for code in entry.warnings)
    return [
        Finding(
            code,
            "info",
            f"{count} of {len(entries)} logs had the warning {code} when they were added",
        )
        for code, count in sorted(counts.items())
    ]


def _make_missing_error(
    ledger: Ledger, robot_id: str, since: datetime | None, until: datetime | None
) -> UsageError | IdentifiabilityError:
    known = ledger.robot_ids()
    if robot_id not in known:
        shown = ", ".join(known[:10]) + (" ..." if len(known) > 10 else "") or "none yet"
        return UsageError(
            f"the ledger {ledger.root} has no robot {robot_id!r}; it has {shown}",
            value=robot_id,
            available=known[:100],
        )
    window = "".join(
        f" {word} {date:%Y-%m-%d %H:%M}"
        for word, date in (("since", since), ("before", until))
        if date
    )
    return IdentifiabilityError(
        f"the ledger {ledger.root} has no sound log of {robot_id}{window}"
        + "".join(f" ({finding.message})" for finding in ledger.findings[:1]),
        cure=Cure("choose other dates"),
    )


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
    for other in ledger.robot_ids():
        if other == robot_id:
            continue
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
    effect = float(np.median(list(map(_estimate_design_effect, parts, fits))))
    noise = effect * np.mean([fit.covariance for fit in fits], axis=0)
    estimates = np.array([fit.beta for fit in fits])
    m = len(fits)
    rows = [
        part.stacked(fit.weights) / np.sqrt(effect) for part, fit in zip(parts, fits, strict=True)
    ]
    mu = estimates.mean(axis=0)
    for _ in range(SIBLING_PASSES):
        mu = _fit_mean(pooled, rows, _estimate_spread(estimates - mu, noise))
    T = _estimate_spread(estimates - mu, noise)
    T *= (1.0 + 1.0 / m) * float(widening(np.array(m - 1.0))) ** 2
    weights = np.median([fit.weights for fit in fits], axis=0)
    prior = SiblingPrior(tuple(robots), mu, T, weights, effect, 1.0)
    squares = [_measure_distance(prior, part)[0] for part in parts]
    return replace(prior, dispersion=max(1.0, float(np.mean(squares))))


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
    m = len(prior.robot_ids)
    square, r = _measure_distance(prior, information)
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
