"""The estimator that a recording calls for, chosen by rules that the summary states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import AsbuiltError
from asbuilt.findings import Cure, Finding
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.bodies.consistency import (
    consistency_margin,
    margin_is_consistent,
    non_passive_drives,
)
from asbuilt.identification.estimators.consistent_fit import (
    estimate_consistent,
    estimate_entropic,
    fit_consistent,
    fit_toward_cad,
    quietest_noise,
)
from asbuilt.identification.estimators.least_squares import LARGE_CONDITION, estimate_wls
from asbuilt.identification.estimators.methods import estimator
from asbuilt.identification.estimators.ridge import estimate_ridge
from asbuilt.identification.estimators.robust import estimate_huber, outlying_share
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.held_out import held_out_errors
from asbuilt.identification.information.square_root_information import SquareRootInformation


@dataclass(frozen=True, slots=True)
class SelectionRules:
    """Thresholds of the automatic choice."""

    outlying_share: float = 0.07
    """Share of torques beyond 4 robust standard deviations; normal noise has 0.006 %."""
    outlying_variance: float = 30.0
    """Residual variance of a joint in robust variances; unmodelled friction alone reaches 12."""
    screened: int = 20_000
    """Samples of a long recording, in evenly spread time blocks, that are searched for outliers."""
    condition_number: float = LARGE_CONDITION
    """Scaled condition number above which the estimate is regularised toward CAD."""
    fewest_folds: int = 3
    """Groups of time blocks below which held-out errors have no usable standard error."""
    costly: float = 0.05
    """Rise of the torque error by a consistent fit beyond that of its lost degrees of freedom."""


RULES = SelectionRules()
CURE = Cure(
    "look for an effect that the description lacks: base tilt, further friction, a tool on the"
    " flange",
    settings={"mounting": "estimate", "drive": "auto"},
)


@estimator(
    "auto",
    "chosen automatically",
    "wls, huber, ridge, consistent or entropic, by rules that the summary states",
    needs="samples",
    held_fixed=(),
)
def estimate_auto(data: EstimationData) -> Estimate:
    """Estimate by the method that rules choose, each rule on the outcome of the one before.

    1. Weighted least squares; `huber` if more than 7 % of the torques lie beyond 4 robust standard
       deviations, or the residual variance of a joint exceeds 30 robust variances.
    2. `ridge` if directions are not excited or the scaled condition number exceeds 200.
    3. If the values so far are physically inconsistent: `consistent`, or `entropic` if that
       predicts better (after `ridge` the other way round), provided that it predicts as well as
       the inconsistent values; otherwise these stay, with a finding.

    Predictions are compared on time blocks held out in turn: "as well" is within one standard
    error of the paired difference, "better" is beyond it (the rule that also chooses the weight of
    CAD). Consistency is certain, so it only must not do harm; nearness to CAD is not, so it must
    do good. Steps 2 and 3 are left out if undetermined directions are refused.
    """
    estimate = estimate_wls(data)
    reasons = []
    if data.samples is not None:
        sample = replace(data, every=max(1, data.information.n_samples // RULES.screened))
        robust = estimate_huber(sample)
        share, ratio = outlying_share(sample, robust)
        if share > RULES.outlying_share or ratio > RULES.outlying_variance:
            estimate = robust if sample.every == 1 else estimate_huber(data)
            reasons.append(
                f"huber: {100 * share:.2g} % of the torques are outliers, and the residual variance"
                f" of one joint is {ratio:.3g} times the robust variance"
            )
    seen = replace(data, information=estimate.information or data.information, samples=None)
    condition = estimate.solution.scaled_condition_number
    if data.undetermined != "refuse":
        if estimate.undetermined or condition > RULES.condition_number:
            why = (
                "directions are not excited"
                if estimate.undetermined
                else f"the scaled condition number is {condition:.3g}"
            )
            ridge = estimate_ridge(seen)
            reasons.append(f"{ridge.method}: {why}")
            estimate = _joined(ridge, estimate)
        if not _is_consistent(data, estimate):
            estimate, why = _consistent(seen, estimate)
            reasons.append(why)
    if not reasons:
        reasons.append("wls: few outliers, well conditioned, physically consistent")
    return replace(
        estimate, notes=(f"Chosen automatically: {'; '.join(reasons)}.", *estimate.notes)
    )


def _joined(later: Estimate, earlier: Estimate) -> Estimate:
    """Return the later estimate on the information of the earlier one, with the notes of both."""
    return replace(
        later,
        information=earlier.information,
        sigma=np.maximum(later.sigma, earlier.sigma),
        notes=(*earlier.notes, *later.notes),
        findings=(*earlier.findings, *later.findings),
    )


def _is_consistent(data: EstimationData, estimate: Estimate) -> bool:
    """Return whether an estimate is physically consistent; True if that cannot be decided."""
    if non_passive_drives(data.base, estimate.beta):
        return False
    try:
        return margin_is_consistent(consistency_margin(data.base, estimate.beta), estimate.beta)
    except AsbuiltError:
        return True


def _consistent(seen: EstimationData, free: Estimate) -> tuple[Estimate, str]:
    """Return a consistent fit, or the free one if that predicts held-out blocks better, and why."""
    information, prior = seen.information, cad_prior(seen.model, seen.base.drive)
    non_passive = non_passive_drives(seen.base, free.beta)
    values = f"the values of {free.method} are " + (
        f"non-passive ({', '.join(non_passive)})" if non_passive else "physically inconsistent"
    )
    energy, n = information.residual_energy(free.beta), information.n_samples
    sigma = np.maximum(
        np.sqrt(energy / max(n - free.rank / information.n_joints, 1.0)),
        quietest_noise(information),
    )
    consistent, entropic = estimate_consistent(seen), estimate_entropic(seen)
    weight, weights = entropic.prior_weight, entropic.weights
    as_before = estimate_ridge if free.method == "ridge" else estimate_wls

    def errors(again: Callable[[SquareRootInformation], Estimate]) -> Array:
        with one_blas_thread():
            squared, _ = held_out_errors(information, lambda part: again(part).beta)
        return np.array([float(np.mean(each / sigma**2)) for each in squared])

    before = errors(lambda part: as_before(replace(seen, information=part)))
    if len(before) < RULES.fewest_folds:
        why = f"consistent: {values}, and the time blocks are too few to hold any out"
        return _costed(information, _joined(consistent, free), free, sigma), why
    candidates = [
        (consistent, errors(lambda part: fit_consistent(part, prior, weights=consistent.weights))),
        (
            entropic,
            errors(lambda part: fit_toward_cad(part, prior, weight=weight, weights=weights)),
        ),
    ]
    if free.method == "ridge":
        candidates.reverse()
    if _better(candidates[1][1], candidates[0][1]):
        candidates.reverse()
    on = f"on {len(before)} groups of held-out time blocks"
    compared = [_compared(fit.method, own, free.method, before) for fit, own in candidates]
    for (fit, own), sentence in zip(candidates, compared, strict=True):
        if not _better(before, own):
            how = "better" if _better(own, before) else "as well within one standard error"
            why = f"{fit.method}: {values}, and it predicts {how} {on} ({sentence})"
            return _costed(information, _joined(fit, free), free, sigma), why
    worse = f"consistent fits predict worse {on} ({'; '.join(compared)})"
    finding = Finding(
        "consistent_fit_rejected",
        "warning",
        f"{values[0].upper()}{values[1:]}, and were kept because {worse}",
        CURE,
    )
    kept = replace(free, findings=(*free.findings, finding))
    return kept, f"{free.method} kept: {values}, but {worse}"


def _better(errors: Array, others: Array) -> bool:
    """Return whether errors (n_folds,) are smaller by over one standard error of the difference."""
    excess = errors - others
    return bool(excess.mean() < -excess.std(ddof=1) / np.sqrt(len(excess)))


def _compared(method: str, errors: Array, other: str, others: Array) -> str:
    excess = errors - others
    return (
        f"squared error of {method} {errors.mean():.3g} noise variances, of {other}"
        f" {others.mean():.3g}, difference {excess.mean():+.2g} +-"
        f" {excess.std(ddof=1) / np.sqrt(len(excess)):.2g}"
    )


def _costed(
    information: SquareRootInformation, fit: Estimate, free: Estimate, sigma: Array
) -> Estimate:
    """Return the consistent fit, with a finding if its torque error is far above the free one's."""
    relative = information.residual_energy(fit.beta) / information.n_samples / sigma**2
    rise = float(np.sqrt(np.mean(relative))) - 1.0
    if rise <= RULES.costly:
        return fit
    finding = Finding(
        "consistent_fit_costly",
        "warning",
        f"The physically consistent fit has {100 * rise:.0f} % more torque error on the data used"
        f" than the inconsistent values of {free.method}",
        CURE,
    )
    return replace(fit, findings=(*fit.findings, finding))
