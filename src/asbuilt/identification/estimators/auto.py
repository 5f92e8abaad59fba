"""The estimator that a recording calls for, picked by rules that the summary states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import AsbuiltError
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
from asbuilt.identification.estimators.least_squares import Estimate, estimate_wls
from asbuilt.identification.estimators.methods import estimator
from asbuilt.identification.estimators.ridge import estimate_ridge, folds
from asbuilt.identification.estimators.robust import estimate_huber, outlying_share
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.square_root_information import SquareRootInformation

OUTLYING_SHARE = 0.07
"""Share of torques beyond 4 robust standard deviations from which the robust estimate is taken."""
OUTLYING_ENERGY = 30.0
"""Or: variance of the residuals of a joint in robust variances, from which it is (1 for normal
noise, up to 12 where only friction is left).
"""
SCREENED = 20_000
"""Samples of a long recording, in evenly spread time blocks, that are looked through for outliers."""
ILL_CONDITIONED = 200.0
"""Scaled condition number from which the design is leant on."""
FEWEST_FOLDS = 3
"""Groups of time blocks below which held-out errors say nothing of their own spread."""
STRAINED = 0.05
"""Rise of the torque error on the data used from which real bodies are said to fit with strain.

More than the parameters they give up account for.
"""
CURE = (
    "Something acts that links and drives as described cannot be: find how the robot stands"
    " (--mounting estimate), choose richer friction (--drive auto), or describe the tool that the"
    " flange carries."
)


@estimator(
    "auto",
    "chosen automatically",
    "wls, huber, ridge, consistent or entropic, by rules that the summary states",
    needs="samples",
    held_fixed=(),
)
def estimate_auto(data: EstimationData) -> Estimate:
    """Estimate by the method that rules pick, each on what the one before has left.

    1. weighted least squares; `huber` where more than 7 % of the torques lie beyond 4 robust
    standard deviations, or a joint's residual variance is more than
       30 times the robust one;
    2. `ridge` where directions are not excited or the scaled condition number is above 200; 3.
    where no real bodies and passive drives have the values found so far, `consistent`, or
    `entropic` where that predicts better (after `ridge` the other way round, for the
       design must be leant on there), if it predicts as well as the values found; else these stay,
       with a warning. Judged on time blocks of this recording held out in turn: as well is within
       one standard error of the difference, group by group, better is beyond it (the rule by which
       the weight of CAD is chosen). That bodies are real is certain, that they are near CAD is not,
       so the one is asked not to do harm, the other to do good.

    Where real bodies have the values found, they stay. With `undetermined="refuse"` steps 2 and 3 are
    left out.
    """
    estimate = estimate_wls(data)
    reasons = []
    if data.samples is not None:
        sample = replace(data, every=max(1, data.information.n_samples // SCREENED))
        robust = estimate_huber(sample)
        share, swell = outlying_share(sample, robust)
        if share > OUTLYING_SHARE or swell > OUTLYING_ENERGY:
            robust = robust if sample.every == 1 else estimate_huber(data)
            reasons.append(
                f"huber, since {100 * share:.2g} % of the torques are outliers and the variance of"
                f" a joint is {swell:.3g} times the robust one"
            )
            estimate = robust
    seen = replace(data, information=estimate.information or data.information, samples=None)
    solution = estimate.solution
    if data.undetermined != "refuse" and (
        estimate.undetermined or solution.scaled_condition_number > ILL_CONDITIONED
    ):
        why = (
            "directions are not excited"
            if estimate.undetermined
            else f"the scaled condition number is {solution.scaled_condition_number:.3g}"
        )
        leaning = estimate_ridge(seen)
        reasons.append(f"{leaning.method}, since {why}")
        estimate = _joined(leaning, estimate)
    if data.undetermined != "refuse" and not _possible(data, estimate):
        estimate, why = _real_bodies(seen, estimate)
        reasons.append(why)
    if not reasons:
        reasons.append("wls: few outliers, well conditioned, and real bodies have these values")
    return replace(
        estimate, notes=(f"Picked automatically: {'; '.join(reasons)}.", *estimate.notes)
    )


def _joined(later: Estimate, earlier: Estimate) -> Estimate:
    """Return the later estimate, judged on the information of the earlier one, both telling what
    they decided.
    """
    return replace(
        later,
        information=earlier.information,
        sigma=np.maximum(later.sigma, earlier.sigma),
        notes=(*earlier.notes, *later.notes),
        warnings=(*earlier.warnings, *later.warnings),
    )


def _possible(data: EstimationData, estimate: Estimate) -> bool:
    """Return whether real bodies and passive drives can have the estimate.

    True where that cannot be decided.
    """
    if non_passive_drives(data.base, estimate.beta):
        return False
    try:
        return margin_is_consistent(consistency_margin(data.base, estimate.beta), estimate.beta)
    except AsbuiltError:
        return True


def _real_bodies(seen: EstimationData, free: Estimate) -> tuple[Estimate, str]:
    """Return the fit of real bodies, or the free one where that predicts held-out blocks better by
    more than one standard error, and why.
    """
    information, prior = seen.information, cad_prior(seen.model, seen.base.drive)
    non_passive = non_passive_drives(seen.base, free.beta)
    who = f"{', '.join(non_passive)} would push with" if non_passive else "no real bodies have"
    energy, n = information.residual_energy(free.beta), information.n_samples
    sigma = np.maximum(
        np.sqrt(energy / max(n - free.rank / information.n_joints, 1.0)),
        quietest_noise(information),
    )
    consistent, entropic = estimate_consistent(seen), estimate_entropic(seen)
    candidates: list[tuple[Estimate, Callable[[SquareRootInformation], Estimate]]] = [
        (consistent, lambda part: fit_consistent(part, prior, weights=consistent.weights)),
        (
            entropic,
            lambda part: fit_toward_cad(
                part, prior, weight=entropic.prior_weight, weights=entropic.weights
            ),
        ),
    ]
    estimator = estimate_ridge if free.method == "ridge" else estimate_wls
    before = _held_out(information, lambda part: estimator(replace(seen, information=part)), sigma)
    if len(before) < FEWEST_FOLDS:
        why = (
            f"consistent, since {who} the values of {free.method}; time blocks are too few to hold"
            " any out"
        )
        return _strained(information, _joined(consistent, free), free, sigma), why
    errors = {
        estimate.method: _held_out(information, again, sigma) for estimate, again in candidates
    }
    preferred = [
        estimate for estimate, _ in (candidates[::-1] if free.method == "ridge" else candidates)
    ]
    if _better(errors[preferred[1].method], errors[preferred[0].method]):
        preferred.reverse()
    told = [_compared(each.method, errors[each.method], free.method, before) for each in preferred]
    on = f"on {len(before)} groups of time blocks held out in turn"
    for real, sentence in zip(preferred, told, strict=True):
        if not _better(before, errors[real.method]):
            judged = (
                "better"
                if _better(errors[real.method], before)
                else "as well within one standard error"
            )
            why = (
                f"{real.method}, since {who} the values of {free.method} and it predicts {judged},"
                f" {on}: {sentence}"
            )
            return _strained(information, _joined(real, free), free, sigma), why
    refused = (
        f"No real bodies have the values of {free.method}, and real bodies predict worse by more"
        f" than one standard error, {on} ({'; '.join(told)}), so these values were kept. {CURE}"
    )
    kept = replace(free, warnings=(*free.warnings, ("consistent_fit_rejected", refused)))
    return (
        kept,
        (
            f"{free.method} kept although no real bodies have its values, since real bodies predict"
            f" worse, {on}: {'; '.join(told)}"
        ),
    )


def _better(errors: Array, others: Array) -> bool:
    """Return whether errors (n_folds,) are smaller than others by more than one standard error of
    the mean difference.
    """
    excess = errors - others
    return bool(excess.mean() < -excess.std(ddof=1) / np.sqrt(len(excess)))


def _compared(method: str, errors: Array, other: str, others: Array) -> str:
    excess = errors - others
    return (
        f"squared error of {method} {errors.mean():.3g} noise variances, of {other}"
        f" {others.mean():.3g}, difference {excess.mean():+.2g} +-"
        f" {excess.std(ddof=1) / np.sqrt(len(excess)):.2g}"
    )


def _strained(
    information: SquareRootInformation, real: Estimate, free: Estimate, sigma: Array
) -> Estimate:
    """Return the fit of real bodies, warning where it follows the data used much worse than the
    free one.
    """
    strain = (
        float(
            np.sqrt(
                np.mean(information.residual_energy(real.beta) / information.n_samples / sigma**2)
            )
        )
        - 1.0
    )
    if strain <= STRAINED:
        return real
    message = (
        f"Real bodies follow the data used with {100 * strain:.0f} % more torque error, in noise of"
        f" the joints, than the values of {free.method}, which no bodies have. {CURE}"
    )
    return replace(real, warnings=(*real.warnings, ("consistent_fit_costly", message)))


def _held_out(
    information: SquareRootInformation,
    again: Callable[[SquareRootInformation], Estimate],
    sigma: Array,
) -> Array:
    """Return the mean squared torque error, in variances `sigma**2` of the joints, on each group of
    blocks held out in turn; empty for one block.
    """
    found = []
    with one_blas_thread():
        for learnt, judged in folds(information):
            found.append(
                float(
                    np.mean(
                        judged.residual_energy(again(learnt).beta) / judged.n_samples / sigma**2
                    )
                )
            )
    return np.array(found)
