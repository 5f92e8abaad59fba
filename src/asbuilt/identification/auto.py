"""The estimator that a recording calls for, picked by rules that the summary states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.errors import AsbuiltError
from asbuilt.identification.cad_prior import cad_prior
from asbuilt.identification.consistency import consistency_margin, margin_is_consistent
from asbuilt.identification.consistent_fit import estimate_consistent, estimate_entropic, fit_toward_cad
from asbuilt.identification.evidence import Evidence
from asbuilt.identification.least_squares import Estimate, estimate_wls
from asbuilt.identification.ridge import estimate_ridge, folds
from asbuilt.identification.robust import estimate_huber, outlying_share
from asbuilt.identification.square_root_information import SquareRootInformation

Array = NDArray[np.float64]

OUTLYING_SHARE = 0.07
"""Share of torques beyond 4 robust standard deviations from which the robust estimate is taken."""
OUTLYING_ENERGY = 30.0
"""Or: variance of the residuals of a joint in robust variances, from which it is (1 for normal noise, up to 12 where only friction is left)."""
SCREENED = 20_000
"""Samples of a long recording, in evenly spread time blocks, that are looked through for outliers."""
ILL_CONDITIONED = 200.0
"""Scaled condition number from which the design is leant on."""
NEGLIGIBLE_COST = 0.05
"""Rise of the torque error on the data used that real bodies may cost,"""
HELD_OUT_COST = 0.01
"""and of that on held-out blocks."""


def estimate_auto(evidence: Evidence) -> Estimate:
    """Estimate by the method that rules pick, each on what the one before has left.

    1. weighted least squares; `huber` where more than 7 % of the torques lie beyond 4 robust standard deviations, or a joint's residual variance is more than
       30 times the robust one;
    2. `ridge` where directions are not excited or the scaled condition number is above 200;
    3. `consistent` or `entropic`, whichever predicts held-out time blocks better, where no real bodies have the values found so far, if the torque error
       on the data used rises by less than 5 % and that on held-out blocks by less than 1 %.

    Where real bodies have the values found, they stay. With `unexcited="refuse"` steps 2 and 3 are left out.
    """
    estimate = estimate_wls(evidence)
    reasons = []
    if evidence.samples is not None:
        sample = replace(evidence, every=max(1, evidence.information.n_samples // SCREENED))
        robust = estimate_huber(sample)
        share, swell = outlying_share(sample, robust)
        if share > OUTLYING_SHARE or swell > OUTLYING_ENERGY:
            robust = robust if sample.every == 1 else estimate_huber(evidence)
            reasons.append(
                f"huber, since {100 * share:.2g} % of the torques are outliers and the variance of a joint is {swell:.3g} times the robust one"
            )
            estimate = robust
    seen = replace(evidence, information=estimate.information or evidence.information, samples=None)
    solution = estimate.solution
    if evidence.unexcited != "refuse" and (estimate.undetermined or solution.scaled_condition_number > ILL_CONDITIONED):
        why = (
            "directions are not excited"
            if estimate.undetermined
            else f"the scaled condition number is {solution.scaled_condition_number:.3g}"
        )
        leaning = estimate_ridge(seen)
        reasons.append(f"{leaning.method}, since {why}")
        estimate = _joined(leaning, estimate)
    if evidence.unexcited != "refuse" and not _possible(evidence, estimate):
        real, why = _real_bodies(evidence, seen, estimate)
        reasons.append(why)
        estimate = real or estimate
    if not reasons:
        reasons.append("wls: few outliers, well conditioned, and real bodies have these values")
    return replace(estimate, notes=(f"Picked automatically: {'; '.join(reasons)}.", *estimate.notes))


def _joined(later: Estimate, earlier: Estimate) -> Estimate:
    """Return the later estimate, judged on the information of the earlier one, both telling what they decided."""
    return replace(
        later, information=earlier.information, sigma=np.maximum(later.sigma, earlier.sigma), notes=(*earlier.notes, *later.notes)
    )


def _possible(evidence: Evidence, estimate: Estimate) -> bool:
    """Return whether real bodies can have the estimate; True where that cannot be decided."""
    try:
        return margin_is_consistent(consistency_margin(evidence.base, estimate.beta), estimate.beta)
    except AsbuiltError:
        return True


def _real_bodies(evidence: Evidence, seen: Evidence, free: Estimate) -> tuple[Estimate | None, str]:
    """Return the best fit of real bodies, None where it costs too much, and why."""
    information = evidence.information
    entropic = estimate_entropic(seen)
    candidates: list[tuple[Estimate, Callable[[Evidence], Estimate]]] = [
        (estimate_consistent(seen), estimate_consistent),
        (entropic, lambda part: fit_toward_cad(part.information, cad_prior(part.model, part.base.drive), weight=entropic.prior_weight)),
    ]
    reference = float(np.sqrt(information.residual_energy(free.beta).sum()))
    cheap, costs = [], []
    for estimate, again in candidates:
        cost = float(np.sqrt(information.residual_energy(estimate.beta).sum())) / reference - 1.0 if reference > 0 else np.inf
        costs.append(f"{estimate.method} {100 * cost:+.2g} %")
        if cost < NEGLIGIBLE_COST:
            cheap.append((estimate, again))
    if not cheap:
        return None, f"{free.method} kept, since real bodies would raise the torque error too much ({', '.join(costs)})"
    errors = [_held_out(seen, again) for _, again in cheap]
    before = _held_out(seen, estimate_ridge if free.method == "ridge" else estimate_wls)
    best = int(np.argmin(errors))
    if errors[best] > (1.0 + HELD_OUT_COST) * before:
        return None, f"{free.method} kept, since real bodies predict held-out blocks worse ({100 * (errors[best] / before - 1):+.2g} %)"
    chosen = cheap[best][0]
    told = f", held-out blocks {100 * (errors[best] / before - 1):+.2g} %" if before > 0 else ""
    return _joined(chosen, free), (
        f"{chosen.method}, since no real bodies have the values of {free.method} and these cost next to nothing "
        f"(torque error of {', '.join(costs)}{told})"
    )


def _held_out(evidence: Evidence, again: Callable[[Evidence], Estimate]) -> float:
    """Return the norm of the torque error on blocks held out in turn; 0 where there is one block only."""
    total = 0.0
    with one_blas_thread():
        for learnt, judged in folds(evidence.information):
            total += _energy(judged, again(replace(evidence, information=learnt)).beta)
    return float(np.sqrt(total))


def _energy(information: SquareRootInformation, beta: Array) -> float:
    return float(information.residual_energy(beta).sum())
