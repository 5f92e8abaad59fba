"""Models that no robot can have, refused before they are written for other software."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.consistency import inconsistencies
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import available_terms
from asbuilt.errors import InertiaError
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.bodies.inconsistency import find_inconsistency
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import SIGNIFICANT_SIGMAS, significant
from asbuilt.validation.comparison.significance import chi_square
from asbuilt.validation.nearest_consistent import BADLY, StandIn

UNKNOWN = 100.0
"""Standard error of a parameter that was dropped, in values that it has in CAD, beside which it
counts as unknown.
"""
CURES = (
    "Identify with real bodies imposed (identify --method consistent, or entropic), which the"
    " report then judges; let it find how the robot stands (--mounting estimate), for free links"
    " imitate a tilt that real ones cannot; or change the drive terms (--drive), for links imitate"
    " what those lack"
)


def impossibilities(model: RobotModel) -> tuple[str, ...]:
    """Return one sentence per link that no rigid body can be and per drive that would push.

    Negative armature, viscous or Coulomb friction.
    """
    reasons = list(inconsistencies(model))
    for number, joint in enumerate(model.joints, start=1):
        for name in ("armature", "viscous", "coulomb"):
            value = getattr(joint.drive, name)
            if value is not None and value < 0.0:
                what = {
                    "armature": "armature",
                    "viscous": "viscous friction",
                    "coulomb": "Coulomb friction",
                }[name]
                reasons.append(f"joint {number}: {what} is {value:.4g}; it must not be negative")
        reasons += [
            f"joint {number}: {key} {symbol} is {numbers[symbol]:.4g}; it must not be negative"
            for key, numbers in joint.drive.terms.items()
            if (term := available_terms().get(key)) is not None and term.non_negative
            for symbol in term.symbols
            if numbers.get(symbol, 0.0) < 0.0
        ]
    return tuple(reasons)


def in_plain_friction(model: RobotModel) -> RobotModel:
    """Return a robot whose asymmetric dry friction is symmetric friction and an offset, and whose
    smooth one is dry, for files that have no other.
    """
    joints = []
    for joint in model.joints:
        drive, terms = joint.drive, dict(joint.drive.terms)
        asymmetric, smooth = (
            terms.pop("asymmetric_coulomb", None),
            terms.pop("smooth_coulomb", None),
        )
        if asymmetric is not None:
            forwards, backwards = asymmetric["Fcp"], asymmetric["Fcn"]
            drive = replace(
                drive,
                coulomb=(drive.coulomb or 0.0) + 0.5 * (forwards + backwards),
                offset=(drive.offset or 0.0) + 0.5 * (forwards - backwards),
            )
        if smooth is not None:
            drive = replace(drive, coulomb=(drive.coulomb or 0.0) + smooth["Fct"])
        joints.append(replace(joint, drive=replace(drive, terms=terms)))
    return replace(model, joints=tuple(joints))


def left_out_drives(model: RobotModel, carried: Collection[str], kind: str) -> tuple[str, ...]:
    """Return a note that names the further drive terms which a kind of file does not carry, with
    the joints that have them; none where it carries all.
    """
    joints: dict[str, list[str]] = {}
    for joint in model.joints:
        for key in joint.drive.terms:
            if key not in carried:
                joints.setdefault(key, []).append(joint.name)
    if not joints:
        return ()
    said = ", ".join(
        key if len(names) == model.n_joints else f"{key} ({', '.join(names)})"
        for key, names in joints.items()
    )
    return (
        (
            f"{kind} has no place for the drive terms {said}; they are left out, and its torques"
            " lack them (robot files of asbuilt, --toml, carry all)"
        ),
    )


def refuse_impossible(model: RobotModel, cure: str = "take the nearest possible robot") -> None:
    """Raise `InertiaError` with every reason and the cure where the model is impossible.

    Simulators would refuse it or blow up.
    """
    reasons = impossibilities(model)
    if reasons:
        raise InertiaError(
            f"{model.name} is not exported, for no robot can have this model: {'; '.join(reasons)}."
            f" Identify with physical consistency (--method consistent), {cure}, or leave out drive"
            " terms that the recording does not tell"
        )


def refuse_impossible_result(result: IdentificationResult, model: RobotModel) -> None:
    """Raise `InertiaError` where the robot as built is impossible, with what proves it and the
    cures.
    """
    if impossibilities(model):
        raise InertiaError(
            f"{result.robot} is not exported, for no robot can have this model:"
            f" {_reasons(result, model)}. {CURES}; or write the nearest robot that can be"
            " (--nearest)"
        )


def _reasons(result: IdentificationResult, model: RobotModel) -> str:
    """Say which base parameters no robot has.

    Where they alone are possible but for a drive or by rounding, what of the model is not.

    Dropped parameters prove nothing: they count as all but unknown.
    """
    prior, dropped = cad_prior(result.model, result.base.drive), np.flatnonzero(result.dropped)
    covariance = np.array(result.covariance)
    covariance[dropped, dropped] = (
        UNKNOWN * (np.abs(result.base.regrouping) @ np.abs(prior.parameters))[dropped]
    ) ** 2
    proof = find_inconsistency(result.base, prior, result.estimates, covariance)
    if proof is not None and (not dropped.size or proof.sigmas >= SIGNIFICANT_SIGMAS):
        return proof.sentence
    zero = (
        f"; the {len(dropped)} parameters that were dropped as needless count as zero, which those"
        " of bodies seldom are"
    )
    return "; ".join(impossibilities(model)) + (zero if dropped.size else "")


def refuse_bad_stand_in(result: IdentificationResult, beta: Array, cost: StandIn | None) -> None:
    """Raise `InertiaError` where the nearest possible robot, of base parameters beta (p,), predicts
    the recordings badly.

    `cost` says so joint by joint; without it, as the result carries no cause data, the growth of the
    error on the data used does.
    """
    head = (
        f"{result.robot} is not exported, for the nearest robot that can be predicts the recordings"
        " badly"
    )
    if cost is not None:
        if cost.bad or cost.worse_than_cad:
            raise InertiaError(
                f"{head}: on {cost.judged_by}, {cost.complaint()}. {CURES}; or write it all the"
                " same (--nearest --force)"
            )
        return
    grown = _error_growth(result, beta)
    if grown > BADLY:
        raise InertiaError(
            f"{head}: its error on the data used is {significant(grown)} times that of the"
            f" identified one. {CURES}; or write it all the same (--nearest --force)"
        )


def _error_growth(result: IdentificationResult, beta: Array) -> float:
    """Return the weighted RMS torque error of other base parameters (p,) on the data used, in
    multiples of that of the estimate.

    `sqrt(1 + d^T C^+ d / (N n - p))` with the textbook covariance C, whose unit is the estimate's
    own error: exact for least squares.
    """
    d, rows = beta - result.estimates, result.n_samples * len(result.joint_names) - result.n_base
    return float(np.sqrt(1.0 + chi_square(d, result.textbook_covariance).statistic / max(rows, 1)))
