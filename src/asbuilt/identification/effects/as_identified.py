"""Effects that are parameters of a model, with the values that were identified."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Indices
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.identification.bodies.cad_prior import build_cad_prior, with_drive_scale
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.families.drive_terms import DriveEffect
from asbuilt.identification.effects.found_effect import FoundEffect, describe_found_effect
from asbuilt.identification.effects.gathering import find_places
from asbuilt.identification.estimators.auto import design_effect, prior_information
from asbuilt.identification.information.held_out import (
    divide_into_folds,
    group_different_motions,
)

if TYPE_CHECKING:
    from asbuilt.identification.identify import Fit
    from asbuilt.identification.result.result import IdentificationResult


def as_identified(found: FoundEffect, result: IdentificationResult) -> FoundEffect:
    """Return an effect with value and error of the result, if it is a parameter of its model.

    So that tables of effects and of parameters have one number.
    """
    effect = EFFECTS.get(found.effect)
    if not (found.in_model and isinstance(effect, DriveEffect)) or found.joint is None:
        return found
    k = result.joint_names.index(found.joint)
    own = find_places(result.base, found.effect, k)
    if not own.size:
        return found
    values, covariance = result.estimates[own], result.covariance[np.ix_(own, own)]
    revolute = result.model.joints[k].is_revolute
    size, error, _ = effect.size(values, covariance, revolute=revolute)
    text = effect.size_text(values, covariance, revolute=revolute)
    before, after = found.error_before, found.error_after
    text = describe_found_effect(effect.title, found.joint, text, before, after)
    return replace(found, estimate=size, std_error=error, text=text)


def describe_stated(
    drive: DriveSet, fit: Fit, result: IdentificationResult
) -> Iterator[FoundEffect]:
    """Yield the effects of drive terms that a user states, as those that a search finds.

    The torque error without and with each is that on held-out groups of different motion, each
    predicted from the others and CAD.
    """
    if not drive.terms:
        return
    information, estimate = fit.information, fit.estimate
    prior = with_drive_scale(build_cad_prior(fit.model, fit.base.drive), information)
    P = design_effect(information, estimate) * prior_information(information, prior)
    toward = P @ fit.base.regrouping @ prior.parameters
    groups = group_different_motions(information, estimate.weights)
    folds = list(divide_into_folds(information, groups)) or [(information, information)]

    def error(left_out: Indices) -> float:
        kept, shares = np.setdiff1d(np.arange(information.base.n_base), left_out), []
        for training, held in folds:
            factor = training.stacked(estimate.weights)
            normal = (factor.T @ factor)[np.ix_(kept, np.append(kept, -1))]
            beta = np.zeros(information.base.n_base)
            beta[kept] = np.linalg.solve(
                normal[:, :-1] + P[np.ix_(kept, kept)], normal[:, -1] + toward[kept]
            )
            shares.append(held.residual_energy(beta).sum() / held.torque_energy.sum())
        return float(np.exp(0.5 * np.mean(np.log(shares))))

    after = error(np.zeros(0, dtype=np.int64))
    for term in drive.terms:
        effect = EFFECTS.get(term.key)
        for k, joint in enumerate(result.joint_names if effect else ()):
            own = find_places(information.base, term.key, k)
            if effect is None or not own.size:
                continue
            acts = np.isin(information.support[k], own)
            added = information.joint_factors[k][:, :-1][:, acts] @ estimate.beta[own]
            torque = float(np.linalg.norm(added)) / np.sqrt(information.n_samples)
            unit = effect.unit(result.model.joints[k].is_revolute)
            sizes = 0.0, 0.0, unit, True, torque, error(own), after
            yield as_identified(FoundEffect(term.key, joint, *sizes, (), ""), result)
