"""Reasons against an identified model, the weightiest first, and its use joint by joint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.plausibility import (
    explain_implausible_links,
    find_wrong_units,
    list_corrections,
)
from asbuilt.findings import Finding, join_names
from asbuilt.identification import FoundEffect, IdentificationResult, non_passive_drives
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.tables import round_significant
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.generalisation.cad_verdict import cad_verdict
from asbuilt.validation.prediction import Validation
from asbuilt.validation.rollout.rollout import Rollout
from asbuilt.validation.verdicts.model_errors import ModelErrors, export_parameters

SAME_EFFECT = {
    "clock_wrong": "clock",
    "joint_gain_wrong": "gain",
    "sensor_crosstalk": "crosstalk",
    "zero_position_wrong": "zero",
}
"""Findings that name an effect which the selection of effects may name too."""
DIMMING: Mapping[str, str] = MappingProxyType(
    {
        "held_out_repeats": "tested on the same motion only",
        "gravity_absent": "the torques follow no gravity",
        "gravity_partial": "the torques follow a part of gravity",
        "gravity_direction": "gravity points elsewhere than described",
        "clock_wrong": "the clock of the log looks wrong",
        "torque_scale": "torques have another scale than masses{at}",
        "joint_torque_scale": "torque of another scale{at}",
        "joint_gain_wrong": "a wrong torque gain{at}",
        "sensor_crosstalk": "cross-talk of torque sensors{at}",
        "foot_moments": "moments under the feet that no point has",
        "zero_position_wrong": "a wrong zero position{at}",
        "torque_does_not_follow": "torque that hardly follows the motion{at}",
        "torque_saturates": "saturated torque{at}",
        "torque_unexplained": "torque that the model does not explain{at}",
        "joint_without_torque": "no torque was logged{at}",
        "not_excited": "what the motion does not excite stays at CAD",
        "motion_narrow": "tested in part of the range only",
        "motion_slow": "tested at low speed only",
        "does_not_generalise": "errors{at} are more than twice those in training",
    }
)
"""Text of each finding that speaks against a model, the weightiest first."""
OF_MOTION = frozenset(
    {"held_out_repeats", "nothing_held_out", "not_excited", "motion_narrow", "motion_slow"}
)
"""Reasons why the error on other motion may be another one than that of the sentence."""
OF_TORQUE = frozenset(
    {
        "torque_scale",
        "joint_torque_scale",
        "joint_gain_wrong",
        "sensor_crosstalk",
        "torque_unexplained",
        "torque_uncorrelated",
        "cad_predicts_better",
        "does_not_generalise",
    }
)
"""Findings on torques that are no measure where commands stand for them."""
USELESS = 0.5
"""Torque error, as a share of the torque, beyond which a model is not used: it explains less than
three quarters of the squared torque, less than gravity alone on most arms."""
WEAK = 0.3
"""Torque error beyond which it is used with care: the drives follow another law than the model's.
"""
BEHIND_CAD = 1.25
"""Error in multiples of CAD's beyond which a model is not used; errors of one model on two motions
of one robot differ by less."""
FAR = 1.5
"""Ratio of a mass to its CAD mass, or its inverse, that no tolerance of CAD explains: covers,
cables and motors which CAD omits are less than half of a robot."""
MATERIAL = 2.9
"""The same for a single link that was drawn in another material: steel to aluminium."""
HEAVIER = 0.1
"""Share of the mass of all links by which a link far from CAD is heavier or lighter, beyond which
its body imitates something that is not in the model. Light links of a wrist may be far from CAD
without harm."""


Use = Literal["yes", "with care", "no", "untested"]


class Reason(NamedTuple):
    """Hold the code of a finding, a phrase, and whether it forbids to use the model."""

    code: str
    text: str
    forbids: bool = False


@dataclass(frozen=True, slots=True)
class JointUse:
    """Say whether to use a model at a joint.

    Parameters
    ----------
    joint
        Name of the joint.
    use
        Whether to use it there; "untested" without a torque channel, or without other motion.
    error
        Error at the joint as a share of its own torque, over all that the fit has not seen; None
        if it is untested.
    """

    joint: str
    use: Use
    error: float | None


def list_reasons_against(
    result: IdentificationResult,
    findings: Sequence[Finding],
    validations: Sequence[Validation],
    simulated: Rollout | None,
    error: ModelErrors,
    joints: Sequence[JointUse],
    *,
    untested: bool,
) -> tuple[Reason, ...]:
    """Return what speaks against the torque of a model, the weightiest first; empty if nothing.

    `untested` is what `is_untested` says.
    """
    unexplained = any(joint_use.use == "no" for joint_use in joints)
    # Errors of a recording that was used all the same.
    checks = [finding for finding in findings if finding.severity == "error"]
    bare = [validation for validation in validations if validation.load is None]
    return (
        *(Reason(finding.code, finding.message, forbids=True) for finding in checks),
        *_list_load_reasons(validations),
        # An error that a load explains is none of the model.
        *(_list_error_reasons(error, simulated) if bare or not validations else ()),
        *([Reason("nothing_held_out", "nothing could be left out")] if untested else []),
        *_list_unexplained_joints(joints),
        *_list_finding_reasons(
            [
                finding
                for finding in findings
                if not (unexplained and finding.code == "torque_unexplained")
            ],
            result.effects,
            len(result.validation),
            simulated,
        ),
        *(_make_effect_reason(effect) for effect in result.effects if _is_omitted(effect)),
        *_list_joint_reasons(bare if simulated is None else ()),
        *_list_simulation_reasons(result, simulated),
    )


def is_untested(
    result: IdentificationResult,
    findings: Sequence[Finding],
    validations: Sequence[Validation],
    simulated: Rollout | None,
) -> bool:
    """Return whether a model was measured on its training data alone, by torque or by motion."""
    measured = simulated is not None or validations or result.validation
    return not measured or any(finding.code == "nothing_held_out" for finding in findings)


def _list_load_reasons(validations: Sequence[Validation]) -> Iterator[Reason]:
    """Yield the recordings that carry a load which the model lacks."""
    for validation in validations:
        if validation.load is not None:
            name = recording_name(validation.source)
            yield Reason("payload_in_log", f"{name} {validation.load.text}")


def _list_error_reasons(error: ModelErrors, simulated: Rollout | None) -> Iterator[Reason]:
    """Yield that CAD is better, or that little of the torque, which decides, is explained."""
    found = error.decisive
    cad = error.cad
    if found is None:
        return
    # A hundredth of an error is no difference to act upon.
    if cad is not None and found > 1.01 * cad:
        yield Reason("cad_predicts_better", "CAD is better", found > BEHIND_CAD * cad)
    if simulated is None and found > WEAK:
        much = "most" if found > USELESS else "much"
        yield Reason("torque_unexplained", f"{much} of the torque is unexplained", found > USELESS)


def decide_joints(
    result: IdentificationResult, validations: Sequence[Validation], *, untested: bool
) -> tuple[JointUse, ...]:
    """Return the use of a model joint by joint, by the torque of all recordings together.

    A joint is not for use if more than `USELESS` of its own torque is unexplained,
    which the norm over all joints hides where others carry more. Recordings with a load that the
    model lacks do not count.
    """
    loaded = {validation.source for validation in validations if validation.load is not None}
    validations = [validation for validation in validations if validation.load is None]
    metrics = [
        validation.metrics_exported or validation.metrics_as_built for validation in validations
    ]
    metrics = metrics or [known for known in result.validation if known.source not in loaded]
    metrics = metrics or [result.train]
    counts = np.array([[metric.n_samples] for metric in metrics])
    rms = np.array([metric.rms for metric in metrics])
    shares = np.array([metric.relative_error_per_joint for metric in metrics])
    with np.errstate(divide="ignore", invalid="ignore"):
        # The torque from error and share: metrics hold no torque of their own.
        torque = np.nan_to_num(rms / shares)
        energy = np.sum(counts * np.nan_to_num(rms) ** 2, axis=0)
        # Squares over all samples, so that long recordings count more.
        errors = np.sqrt(energy / np.sum(counts * torque**2, axis=0))
    behind = _find_joints_behind_cad(validations)
    return tuple(
        _decide_joint(name, error, behind=name in behind, untested=untested)
        for name, error in zip(result.joint_names, errors.tolist(), strict=True)
    )


def _find_joints_behind_cad(validations: Sequence[Validation]) -> list[str]:
    """Return the joints where CAD predicts some recording better, beyond chance."""
    behind = [
        joint.joint
        for validation in validations
        for joint in cad_verdict(validation).joints
        if joint.outcome == "worse"
    ]
    return list(dict.fromkeys(behind))


def _decide_joint(name: str, error: float, *, behind: bool, untested: bool) -> JointUse:
    if not np.isfinite(error):
        return JointUse(name, "untested", None)
    shown = None if untested else error
    # Even the training data are not explained: no other motion need be asked.
    if error > USELESS:
        return JointUse(name, "no", shown)
    if untested:
        return JointUse(name, "untested", None)
    return JointUse(name, "with care" if behind or error > WEAK else "yes", shown)


def _list_unexplained_joints(joints: Sequence[JointUse]) -> Iterator[Reason]:
    """Yield the joints that are not for use, if others are."""
    lost = [joint_use for joint_use in joints if joint_use.use == "no"]
    # If all joints are lost the error of the whole has said it.
    if not lost or len(lost) == len(joints):
        return
    lost.sort(key=lambda joint_use: -(joint_use.error or 0.0))
    at = join_names([joint_use.joint for joint_use in lost])
    shares = join_names(
        [f"{100 * joint_use.error:.0f}" for joint_use in lost if joint_use.error is not None]
    )
    yield Reason(
        "torque_unexplained",
        f"not for use at {at} ({shares or 'most'}{' %' if shares else ''} of the torque"
        " unexplained)",
    )


def _list_finding_reasons(
    findings: Sequence[Finding],
    effects: Sequence[FoundEffect],
    n_validations: int,
    simulated: Rollout | None,
) -> Iterator[Reason]:
    """Yield the findings that dim a verdict, in the order of `DIMMING`, but what is an effect."""
    named = {effect.effect for effect in effects if _is_omitted(effect)}
    for code, phrase in DIMMING.items():
        found = [finding for finding in findings if finding.code == code]
        # The effect itself is a reason already, with its size.
        passed_over = (
            SAME_EFFECT.get(code) in named
            # One recording of another motion is enough to be tested.
            or (code == "held_out_repeats" and len(found) < n_validations)
            or (simulated is not None and code in OF_TORQUE)
        )
        if found and not passed_over:
            names = list(
                dict.fromkeys(finding.joint for finding in found if finding.joint is not None)
            )
            yield Reason(code, phrase.format(at=f" at {join_names(names, 3)}" if names else ""))


def _is_omitted(effect: FoundEffect) -> bool:
    """Return whether an effect is left out that a model or a sheet could hold."""
    family = EFFECTS[effect.effect]
    return not effect.in_model and (family.in_model or family.of_log)


def _make_effect_reason(effect: FoundEffect) -> Reason:
    family = EFFECTS[effect.effect]
    unit = "" if effect.unit == "1" else effect.unit
    size = f"{round_significant(effect.estimate, 2)} {unit}".rstrip()
    if family.of_shares:
        size = family.text_of(effect.estimate, None, revolute=True)
    at = "" if effect.joint is None else f" at {effect.joint}"
    where = "in the log" if family.of_log else "not in the model"
    return Reason("effect_found", f"{family.title} of {size}{at} {where}")


def _list_joint_reasons(validations: Sequence[Validation]) -> Iterator[Reason]:
    """Yield the joints where CAD predicts other motion better, beyond chance."""
    names = _find_joints_behind_cad(validations)
    if names:
        yield Reason("cad_predicts_better", f"CAD is better at {join_names(names, 3)}")


def list_reasons_against_bodies(result: IdentificationResult) -> tuple[Reason, ...]:
    """Return why the exported links are no bodies to simulate or to reason about.

    Torques can be right all the same: they depend on base parameters alone.
    """
    return (*_list_consistency_reasons(result), *_list_body_reasons(result))


def _list_consistency_reasons(result: IdentificationResult) -> Iterator[Reason]:
    """Yield that simulators do not take the parameters."""
    if result.physically_consistent is not False:
        return
    if names := non_passive_drives(result.base, result.estimates):
        yield Reason(
            "non_passive_drives", f"negative {join_names(names, 3)}, which no simulator takes", True
        )
    else:
        yield Reason("inconsistent", "physically inconsistent, so that no simulator takes it", True)


def _list_body_reasons(result: IdentificationResult) -> Iterator[Reason]:
    """Yield links that cannot be, and masses that imitate what is not in the model."""
    found = export_parameters(result)
    if found is None:
        return
    links = result.model.links
    parameters = found[: 10 * len(links)]
    yield from _list_absurd_links(result.model, parameters)
    masses = parameters[9::10].tolist()
    built = float(sum(masses))
    # Of masses that cannot be, those that the file may mean are measures as well as those it says.
    readings = [
        [float(link.inertia.mass) for link in model.links]
        for model in (result.model, *list_corrections(result.model))
    ]
    nearest = min(readings, key=lambda reading: abs(sum(reading) - built))
    total = sum(nearest)
    known = all(link.inertia_known for link in links) and total > 0.0
    # Far from CAD on the whole: single links need not be named.
    if known and not 1.0 / FAR <= built / total <= FAR:
        text = f"{round_significant(built)} kg for {round_significant(total)} of CAD"
        yield Reason("link_mass_differs", text, forbids=True)
        return
    off = []
    for link, mass, *stated in zip(links, masses, *readings, strict=True):
        cad = min(stated, key=lambda reading: abs(reading - mass))
        # A light link may be far from CAD without harm.
        is_heavier = abs(mass - cad) > HEAVIER * total
        if link.has_mass and not 1.0 / FAR <= mass / cad <= FAR and is_heavier:
            off.append((abs(mass - cad), link.name, mass, cad))
    if off:
        _, name, mass, cad = max(off)
        yield Reason(
            "link_mass_differs",
            f"{name} has {round_significant(mass)} kg for {round_significant(cad)} of CAD",
            forbids=not 1.0 / MATERIAL <= mass / cad <= MATERIAL,
        )


def _list_absurd_links(model: RobotModel, parameters: Array) -> Iterator[Reason]:
    """Yield exported links whose mass and inertia no body has; CAD may have them like that."""
    absurd = [*explain_implausible_links(model.with_parameters(parameters))]
    if not absurd:
        return
    as_in_cad = absurd == [*explain_implausible_links(model)]
    is_unit = find_wrong_units(model) is not None
    says = ", nor are CAD's" if as_in_cad and not is_unit else ""
    yield Reason(
        "implausible_bodies",
        f"mass and inertia of {join_names(absurd, 3)} cannot be of one link{says}",
        # What the log leaves open stays at CAD, with its unit; one link alone was so before.
        forbids=is_unit or not as_in_cad,
    )


def _list_simulation_reasons(
    result: IdentificationResult, simulated: Rollout | None
) -> Iterator[Reason]:
    """Yield what speaks against a robot identified from commands in its simulation."""
    if not result.decided_by_motion:
        return
    # Commands without simulated motion are no test of a model.
    if simulated is None:
        if result.validation:
            yield Reason("nothing_simulated", "its motion was not simulated")
        return
    built = simulated.as_built
    plain = simulated.no_physics
    if built is not None and built.diverged:
        yield Reason("rollout_diverged", "simulations diverge")
    if built is not None and plain is not None and built.rms_all > plain.rms_all:
        yield Reason(
            "rollout_worse_than_command",
            f"the delayed command alone is closer ({1e3 * plain.rms_all:.3g})",
        )
