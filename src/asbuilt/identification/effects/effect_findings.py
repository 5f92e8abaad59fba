"""What is reported of effects: findings, and values and errors of those in a model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics import BaseParameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.bodies.cad_prior import build_cad_prior, with_drive_scale
from asbuilt.identification.effects.effect import EFFECTS, FoundEffect, find_places
from asbuilt.identification.effects.families.drive_terms import DriveEffect
from asbuilt.identification.effects.search import Effects
from asbuilt.identification.effects.trials import RULES
from asbuilt.identification.estimators.auto import design_effect, prior_information
from asbuilt.identification.estimators.held_out_choice import (
    divide_into_folds,
    group_different_motions,
)
from asbuilt.tables import format_plus_minus

if TYPE_CHECKING:
    from asbuilt.identification.identify import Fit
    from asbuilt.identification.result.result import IdentificationResult

FEWEST_ALIKE = 3
"""Springs of one stiffness from which on that is no chance: two agree often."""
APPLY = Cure("identify with it", {"effects": "auto"})


def report_effects(effects: Effects) -> tuple[Finding, ...]:
    """Return what can be done about effects, and what the log would not show."""
    if effects.problem:
        return (
            Finding(
                "effects_not_sought",
                "warning",
                f"Whether something acts that the description lacks was not asked:"
                f" {effects.problem}",
                Cure("record longer, and several motions"),
            ),
        )
    return (*_report_missing(effects), *_report_unseen(effects))


def _report_missing(effects: Effects) -> Iterator[Finding]:
    """Yield what can be done about effects that are not in the model."""
    for known in effects.found:
        effect = EFFECTS[known.effect]
        if known.in_model:
            continue
        message = f"Not in the model: {known.text}"
        finding = (
            Finding("effect_found", "warning", message, APPLY, joint=known.joint)
            if effect.in_model
            else effect.finding(known, effects.model)
        )
        if finding is not None:
            # A finding is ranked by squares, errors are roots of squares.
            kept = known.error_after / known.error_before if known.error_before > 0.0 else 1.0
            # the share of the squared torque error that the effect takes away
            yield replace(finding, torque=max(0.0, 1.0 - kept**2), effect=known.effect)


def _report_unseen(effects: Effects) -> Iterator[Finding]:
    """Yield errors of the log, larger than any log should hide, that this one does not show."""
    names = effects.model.joint_names
    named = {(known.effect, known.joint) for known in effects.found}
    for key, effect in EFFECTS.items():
        sized = list[str]()
        never = list[str]()
        for (sought, joint), size in effects.unseen.items():
            name = None if joint is None else names[joint]
            # At `farthest` no size that robots have would show: no number is said.
            if sought != key or size <= effect.shown or (key, name) in named:
                continue
            if size >= effect.farthest:
                never.append(name or "")
                continue
            revolute = joint is None or effects.model.joints[joint].is_revolute
            text = effect.text_of(size, None, revolute=revolute)
            sized.append(f"below {text}" + (f" at {name}" if name else ""))
        if never:
            sized.append("of any size" + (f" at {join_names(never)}" if any(never) else ""))
        if sized:
            yield effect.unseen(join_names(sized))


def as_identified(found: FoundEffect, fit: Fit, result: IdentificationResult) -> FoundEffect:
    """Return an effect with value and error of the result, if it is a parameter of its model.

    So that tables of effects and of parameters have one number. Where the result's error would not
    let it be there, since the value has a known bias by what the model lacks, it has the value next
    to that, and the text both.
    """
    effect = EFFECTS.get(found.effect)
    if not (found.in_model and isinstance(effect, DriveEffect)) or found.joint is None:
        return found
    k = result.joint_names.index(found.joint)
    places = find_places(result.base, found.effect, k)
    if not places.size:
        return found
    revolute = result.model.joints[k].is_revolute
    own = result.estimates[places], result.covariance[np.ix_(places, places)]
    beside = fit.next_to_omitted(places)
    hidden = is_sure(*beside) and not is_sure(*own)
    known = effect.found(
        found.joint,
        *(beside if hidden else own),
        revolute=revolute,
        in_model=True,
        torque=found.torque,
        errors=(found.error_before, found.error_after),
        alternatives=found.alternatives,
    )
    if not hidden:
        return known
    size, _, _ = effect.size(*own, revolute=revolute)
    whole = effect.text_of(size, None, revolute=revolute)
    stands_for = f" ({whole} in the model, which lacks other effects that act alike)"
    return replace(known, text=known.text.replace(": torque error", f"{stands_for}: torque error"))


def list_term_places(
    found: Iterable[FoundEffect], base: BaseParameters, joint_names: Sequence[str]
) -> Iterator[tuple[FoundEffect, Indices]]:
    """Yield effects of a model that are there or not by the values of drive terms, with places.

    That another form of friction is zero is no question, and forms with nonlinear parameters have
    values.
    """
    for effect in found:
        term = getattr(EFFECTS[effect.effect], "term", None)
        if not effect.in_model or effect.joint is None or term is None:
            continue
        if term.stands_for or any(parameter.fitted for parameter in term.nonlinear):
            continue
        places = find_places(base, effect.effect, joint_names.index(effect.joint))
        if places.size:
            yield effect, places


def is_sure(values: Array, covariance: Array) -> bool:
    """Return whether values (m,) are two standard errors or more from zero, by the parameter."""
    square = float(values @ np.linalg.pinv(covariance) @ values)
    return square >= RULES.two_errors**2 * len(values)


def report_springs_alike(result: IdentificationResult) -> Iterator[Finding]:
    """Name the one cause of torsion springs in a model that have one stiffness within their errors.

    Springs of their own have stiffnesses of their own; a bundle of cables or hoses along the arm
    has one, and every joint twists it. By weighted least squares and its chi-square.
    """
    own = [each for each in result.effects if each.effect == "spring" and each.in_model]
    joints = [each.joint for each in own if each.joint is not None and each.unit == "N m/rad"]
    if len(joints) < FEWEST_ALIKE:
        return
    places = np.concatenate(
        [find_places(result.base, "spring", result.joint_names.index(name)) for name in joints]
    )
    values = result.estimates[places]
    weight = np.linalg.pinv(result.covariance[np.ix_(places, places)])
    information = float(weight.sum())
    common = float(weight.sum(axis=0) @ values) / information
    error = information**-0.5
    off = values - common
    if common < RULES.two_errors * error or off @ weight @ off > chdtri(len(joints) - 1, 0.05):
        return
    yield Finding(
        "springs_alike",
        "info",
        f"The springs at {join_names(joints)} have one stiffness,"
        f" {format_plus_minus(common, error)} N m/rad, and so one cause, such as a bundle of cables"
        " or hoses that all of these joints twist",
        Cure("look at what runs through or along the arm"),
        effect="spring",
    )


def as_by_encoders(found: FoundEffect, result: IdentificationResult) -> FoundEffect:
    """Return the armature of a joint with two encoders as these have it, other effects as they are.

    The twist of the drive shows the torque behind the rotor, so that it alone is determined where
    torques determine its sum with the link: one rotor has one number.
    """
    pair = next((encoder for encoder in result.encoders if encoder.joint == found.joint), None)
    if found.effect != "armature" or pair is None or pair.rotor is None or not pair.rotor_error:
        return found
    return EFFECTS[found.effect].found(
        found.joint,
        np.array([pair.rotor]),
        np.array([[pair.rotor_error**2]]),
        revolute=pair.revolute,
        in_model=found.in_model,
        torque=found.torque,
        errors=(found.error_before, found.error_after),
        alternatives=found.alternatives,
    )


def describe_stated(
    drive: DriveSet, fit: Fit, result: IdentificationResult
) -> Iterator[FoundEffect]:
    """Yield the effects of drive terms that a user states, as a search would find them.

    The torque errors without and with each are on held-out groups of different motion, each
    predicted from the others and CAD.
    """
    if not drive.terms:
        return
    # Same objective as in the search: what others' motion and CAD's quadratic form say.
    information = fit.information
    estimate = fit.estimate
    prior = with_drive_scale(build_cad_prior(fit.model, fit.base.drive), information)
    P = design_effect(information, estimate) * prior_information(information, prior)
    toward = P @ fit.base.regrouping @ prior.parameters
    groups = group_different_motions(information, estimate.weights)
    # With too few groups for folds the error is that of the fit itself.
    folds = list(divide_into_folds(information, groups)) or [(information, information)]

    def error(left_out: Indices) -> float:
        kept = np.setdiff1d(np.arange(information.base.n_base), left_out)
        shares = []
        for training, held in folds:
            factor = training.stacked(estimate.weights)
            # The last row and column of the Gram matrix are the torque's.
            normal = (factor.T @ factor)[np.ix_(kept, np.append(kept, -1))]
            beta = np.zeros(information.base.n_base)
            beta[kept] = np.linalg.solve(
                normal[:, :-1] + P[np.ix_(kept, kept)], normal[:, -1] + toward[kept]
            )
            shares.append(held.residual_energy(beta).sum() / held.torque_energy.sum())
        # Geometric mean over groups, as in the selection: no group of large torques outweighs the
        # rest.
        return float(np.exp(0.5 * np.mean(np.log(shares))))

    after = error(np.zeros(0, dtype=np.int64))
    for term in drive.terms:
        effect = EFFECTS.get(term.key)
        for k, joint in enumerate(result.joint_names if effect else ()):
            places = find_places(information.base, term.key, k)
            if effect is None or not places.size:
                continue
            acts = np.isin(information.support[k], places)
            # The columns hold the square root of the information: their length is the torque's
            # energy.
            added = information.joint_factors[k][:, :-1][:, acts] @ estimate.beta[places]
            yield effect.found(
                joint,
                result.estimates[places],
                result.covariance[np.ix_(places, places)],
                revolute=result.model.joints[k].is_revolute,
                in_model=True,
                torque=float(np.linalg.norm(added)) / np.sqrt(information.n_samples),
                errors=(error(places), after),
            )
