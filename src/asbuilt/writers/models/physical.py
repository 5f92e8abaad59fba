"""What model files refuse and what they leave out: inconsistent models and drive terms."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.description.plausibility import (
    explain_implausible_links,
    find_inconsistencies,
    find_wrong_units,
)
from asbuilt.dynamics import available_terms
from asbuilt.errors import InertiaError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.bodies.consistency import find_inconsistency
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import SIGNIFICANT_SIGMAS, round_significant
from asbuilt.validation.comparison.significance import chi_square
from asbuilt.validation.verdicts.model_errors import POOR_ERROR, NearestModel

CURE = Cure(
    "identify with physical consistency, identify the base tilt, change the drive terms, or export"
    " the nearest consistent model",
    {"method": "consistent", "mounting": "estimate", "drive": "LIST", "nearest": True},
)
FORCED = Cure(
    "identify with physical consistency, identify the base tilt, change the drive terms, or export"
    " it all the same",
    {**CURE.settings, "force": True},
)


def list_impossibilities(model: RobotModel) -> tuple[str, ...]:
    """Return one sentence per inconsistent link and per non-passive drive parameter."""
    reasons = list(find_inconsistencies(model))
    for number, joint in enumerate(model.joints, start=1):
        bounded = {
            "armature": joint.drive.armature,
            "viscous friction": joint.drive.viscous,
            "Coulomb friction": joint.drive.coulomb,
        } | {
            f"{key} {symbol}": numbers.get(symbol)
            for key, numbers in joint.drive.terms.items()
            # Terms of a plug-in that is not installed cannot be judged.
            if (term := available_terms().get(key)) is not None and term.non_negative
            for symbol in term.symbols
        }
        reasons += [
            f"joint {number}: {what} is {value:.4g}; it must not be negative"
            for what, value in bounded.items()
            if value is not None and value < 0.0
        ]
    return tuple(reasons)


def convert_to_plain_friction(model: RobotModel) -> RobotModel:
    """Return a robot with plain Coulomb friction, for files that hold no other."""
    joints = (replace(joint, drive=make_friction_plain(joint.drive)) for joint in model.joints)
    return replace(model, joints=tuple(joints))


def make_friction_plain(drive: DriveValues) -> DriveValues:
    """Return a drive with plain Coulomb friction.

    Asymmetric friction becomes symmetric friction and an offset, smooth friction dry friction.
    """
    terms = dict(drive.terms)
    asymmetric = terms.pop("asymmetric_coulomb", None)
    smooth = terms.pop("smooth_coulomb", None)
    if asymmetric is not None:
        forwards = asymmetric["Fcp"]
        backwards = asymmetric["Fcn"]
        # Fcp forwards and -Fcn backwards are a mean with the sign of motion, and half the
        # difference.
        drive = replace(
            drive,
            coulomb=(drive.coulomb or 0.0) + 0.5 * (forwards + backwards),
            offset=(drive.offset or 0.0) + 0.5 * (forwards - backwards),
        )
    if smooth is not None:
        # Beyond its width smooth friction is dry friction.
        drive = replace(drive, coulomb=(drive.coulomb or 0.0) + smooth["Fct"])
    return replace(drive, terms=terms)


def note_left_out_drives(model: RobotModel, carried: Collection[str], kind: str) -> tuple[str, ...]:
    """Return a note on drive terms, with their joints, that a kind of file does not hold."""
    lost = [key for joint in model.joints for key in joint.drive.terms if key not in carried]
    joints = {
        key: [joint.name for joint in model.joints if key in joint.drive.terms] for key in lost
    }
    if not joints:
        return ()
    listed = ", ".join(
        key if len(names) == model.n_joints else f"{key} ({', '.join(names)})"
        for key, names in joints.items()
    )
    best = "; a fit with the drive terms armature, viscous, coulomb and offset serves it best"
    return (
        # The remedy helps only where Stribeck terms are what the file cannot hold.
        f"{kind} has no place for the drive terms {listed}; its torques lack them (robot files"
        f" of asbuilt hold all{best if 'stribeck' in joints else ''})",
    )


def refuse_inconsistent(model: RobotModel, result: IdentificationResult | None = None) -> None:
    """Raise `InertiaError` with every reason if the model is physically inconsistent.

    Of the robot as built of a `result` the reason is the proof by its base parameters.
    """
    reasons = "; ".join(list_impossibilities(model))
    if reasons:
        raise InertiaError(
            f"{model.name} is not exported, because its model is physically inconsistent:"
            f" {reasons if result is None else _name_reasons(result, reasons)}",
            cure=CURE,
        )


def refuse_wrong_units(model: RobotModel) -> None:
    """Raise `InertiaError` if masses, inertias or lengths of a described robot are in other units.

    What the recordings do not determine of a link is taken from CAD, absurd as it is.
    """
    wrong = find_wrong_units(model)
    if wrong is not None:
        raise InertiaError(
            f"{model.name} is not exported, because its description is in other units:"
            f" {wrong.message}",
            cure=wrong.cure,
        )


def note_implausible_links(model: RobotModel) -> tuple[str, ...]:
    """Return a note per link whose mass properties no body of its size has."""
    return tuple(
        f"IMPLAUSIBLE link {name}: {reason}"
        for name, reason in explain_implausible_links(model).items()
    )


def _name_reasons(result: IdentificationResult, reasons: str) -> str:
    """Return which base parameters are inconsistent, or else the reasons of the model.

    Dropped parameters prove nothing: they count as unknown.
    """
    # The proof asks for bodies near CAD, and so starts from the masses of CAD.
    prior = build_cad_prior(result.model, result.base.drive)
    dropped = np.flatnonzero(result.dropped)
    covariance = np.array(result.covariance)
    # Standard error of a dropped parameter, in multiples of its CAD value, that leaves it unknown.
    covariance[dropped, dropped] = (
        100.0 * (np.abs(result.base.regrouping) @ np.abs(prior.parameters))[dropped]
    ) ** 2
    proof = find_inconsistency(result.base, prior, result.estimates, covariance)
    # With dropped parameters an inconsistency may be theirs: only a clear proof is told.
    if proof is not None and (not dropped.size or proof.sigmas >= SIGNIFICANT_SIGMAS):
        return proof.sentence
    zero = f"; the {len(dropped)} dropped parameters count as zero, which is rare for links"
    return reasons + (zero if dropped.size else "")


def refuse_poor_nearest_model(
    result: IdentificationResult, beta: Array, cost: NearestModel | None
) -> None:
    """Refuse a nearest consistent model, of base parameters beta (p,), that predicts poorly.

    Without `cost`, since the result has no cause data, the growth of the training error decides.
    Raises `InertiaError`.
    """
    if cost is not None:
        # Worse than CAD is worse than no identification.
        poor = bool(cost.bad) or cost.worse_than_cad
        why = f"on {cost.judged_by}, {cost.objection()}"
    else:
        grown = _measure_error_growth(result, beta)
        poor = grown > POOR_ERROR
        why = (
            f"its error on the training data is {round_significant(grown)} times the identified"
            " model's"
        )
    if poor:
        raise InertiaError(
            f"{result.robot} is not exported: the nearest consistent model predicts the recordings"
            f" poorly: {why}",
            cure=FORCED,
        )


def _measure_error_growth(result: IdentificationResult, beta: Array) -> float:
    """Return the error of other base parameters (p,) on the data used relative to the estimate's.

    `sqrt(1 + d^T C^+ d / (N n - p))` with the textbook covariance C, whose unit is the estimate's
    own error: exact for least squares.
    """
    # Squares of the residuals at the estimate and of the step add: least squares has them
    # orthogonal.
    d = beta - result.estimates
    rows = result.n_samples * len(result.joint_names) - result.n_base
    return float(np.sqrt(1.0 + chi_square(d, result.textbook_covariance).statistic / max(rows, 1)))
