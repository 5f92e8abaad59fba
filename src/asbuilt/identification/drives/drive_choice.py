"""Drive terms to identify with, values of their nonlinear parameters, and all at the motor."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, available_terms, find_base_parameters
from asbuilt.dynamics.drives.torque import choose_usual_drive, keep_driven_joints
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding
from asbuilt.identification.drives.nonlinear_parameters import NonlinearPlace, fit_nonlinear
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.families.drive_terms import DriveEffect, drop_terms
from asbuilt.identification.effects.search import find_effects
from asbuilt.identification.estimators.held_out_choice import (
    group_neighbours,
    measure_held_out_errors,
)
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.uncertainty import FEWEST_BLOCKS

AUTO = "auto"


@dataclass(frozen=True, slots=True, eq=False)
class DriveChoice:
    """Hold drive terms with values of all nonlinear parameters.

    Parameters
    ----------
    drive
        The terms.
    sentences, findings
        Reasons, and what is wrong with the choice.
    fitted
        Nonlinear parameters that the data determine.
    """

    drive: DriveSet
    sentences: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    fitted: tuple[NonlinearPlace, ...] = ()

    def without(
        self, places: Collection[tuple[str, str]], joint_names: Sequence[str]
    ) -> DriveChoice:
        """Return the choice without terms of some keys at some joints, by name."""
        drive = drop_terms(self.drive, places, joint_names)
        gone = set(self.drive.keys) - set(drive.keys)
        return replace(
            self,
            drive=drive,
            # What was fitted for terms that no joint has any more is no reason.
            sentences=tuple(
                sentence
                for sentence in self.sentences
                if not any(f" of {key}, fitted" in sentence for key in gone)
            ),
            fitted=tuple(place for place in self.fitted if place.is_of(drive)),
        )


def settle_drive(
    model: RobotModel, samples: Sequence[Samples], drive: DriveSet | str | None = None
) -> DriveChoice:
    """Return the drive terms to identify with, their nonlinear parameters fitted.

    `drive` is as in `select_stated_drive`; "auto" adds the terms that the samples show.
    """
    stated = select_stated_drive(model, samples, drive)
    if not isinstance(drive, str):
        return settle_nonlinear(model, samples, stated)
    found = find_effects(model, stated, samples, keys=list_drive_effects())
    choice = settle_nonlinear(model, samples, found.drive)
    return replace(choice, fitted=(*found.fitted, *choice.fitted))


def select_stated_drive(
    model: RobotModel, samples: Sequence[Samples], drive: DriveSet | str | None = None
) -> DriveSet:
    """Return the drive terms that are stated.

    Parameters
    ----------
    model, samples
        Robot and recordings.
    drive
        None for the usual terms of robot and torque source, a set, or text such as "auto" or
        "auto,spring:joints=2": the usual terms and those listed.

    Raises
    ------
    UsageError
        If a text does not contain "auto".
    """
    if isinstance(drive, DriveSet):
        return keep_driven_joints(model, drive)
    usual = choose_usual_drive(model, samples[0].torque_source)
    if drive is None:
        return usual
    parts = [part.strip() for part in drive.split(",")]
    others = [part for part in parts if part.lower() != AUTO]
    if len(others) == len(parts):
        raise UsageError(
            f"drive terms {drive!r} do not leave a choice; expected a DriveSet, or {AUTO!r} in it"
        )
    for term in DriveSet.parse(others).terms:
        usual = usual.with_term(term)
    return keep_driven_joints(model, usual)


def list_drive_effects(*, by_construction: bool = False) -> tuple[str, ...]:
    """Return the keys of the effects that are drive terms, with those over position if asked."""
    return tuple(
        key
        for key, effect in EFFECTS.items()
        if isinstance(effect, DriveEffect) and (by_construction or not effect.term.by_construction)
    )


def settle_nonlinear(model: RobotModel, samples: Sequence[Samples], drive: DriveSet) -> DriveChoice:
    """Return terms with fitted nonlinear parameters, compared with the terms without these."""
    if drive.is_linear:
        return DriveChoice(drive)
    nonlinear = [term for term in drive.terms if term.free_nonlinear]
    plain = drive.without(*(term.key for term in nonlinear))
    for term in nonlinear:
        if term.stands_for is not None and term.stands_for not in plain.keys:
            plain = plain.with_term(available_terms()[term.stands_for])
    found = fit_nonlinear(model, drive, samples)
    sentences = found.sentences(model.joint_names)
    findings = found.findings(model.joint_names)
    before, after = (_predict_held_out(model, samples, each) for each in (plain, found.drive))
    if before is not None and after is not None:
        gain = _measure_gain(before, after)
        change = (
            f"torque error on held-out blocks {-100 * gain:+.1f} % against {_name_terms(plain)}"
        )
        sentences = (*sentences, change)
        if gain < 0:
            listed = ", ".join(term.key for term in nonlinear)
            message = f"Fitted {listed} do not lower the torque error: {change}"
            cure = Cure("leave them out, or state their parameters")
            findings = (*findings, Finding("nonlinear_parameters", "warning", message, cure))
    return DriveChoice(found.drive, sentences, findings, fitted=found.places)


def _measure_gain(before: Array, after: Array) -> float:
    """Return the fraction by which squared errors (folds,) or (folds, n) lower the RMS error.

    Joints without torque have no error, and no part in it.
    """
    seen = np.broadcast_to(np.any(before > 0.0, axis=0), before.shape)
    ratio = (before[seen] / after[seen]).reshape(len(before), -1)
    logs = 0.5 * np.log(ratio).mean(axis=1)
    return -float(np.expm1(-float(logs.mean())))


def _predict_held_out(
    model: RobotModel, samples: Sequence[Samples], drive: DriveSet
) -> Array | None:
    """Return squared errors per held-out sample (folds, n); None with too few blocks."""
    information = accumulate_stream(model, find_base_parameters(model, drive), samples)
    if information.n_blocks < FEWEST_BLOCKS:
        return None
    prior = np.zeros(information.base.n_base)
    weights = 1.0 / fit_least_squares(information, weights="joint", prior=prior).sigma
    return measure_held_out_errors(
        information,
        lambda part: fit_least_squares(part, weights=weights, prior=prior).beta,
        group_neighbours(information.n_blocks),
    )[0]


def _name_terms(drive: DriveSet) -> str:
    """Return the keys of a set, with the joints of terms that only some have."""
    return ", ".join(
        term.key
        + (
            ""
            if term.joints is None
            else f" (joint{'s' if len(term.joints) > 1 else ''} {', '.join(map(str, term.joints))})"
        )
        for term in drive.terms
    )


@dataclass(frozen=True, slots=True)
class MotorSideParameter:
    """Hold a drive parameter at the joint and at the motor, `std_error` and `unit` at the motor."""

    name: str
    gear_ratio: float
    joint_side: float
    motor_side: float
    std_error: float
    unit: str


def motor_side_parameters(result: IdentificationResult) -> tuple[MotorSideParameter, ...]:
    """Return the drive parameters at the motor of all joints with a known gear ratio N.

    With `theta_motor = N q` and `tau_joint = N tau_motor`: inertia, viscous friction and stiffness
    shrink by N^2, torques by N, `qd |qd|` by N^3, `qd^3` by N^4; for a power of speed with exponent
    a by N^(1 + a). A parameter that is regrouped with links is left out: its value is not the
    drive's alone. Raises `DescriptionError` if no gear ratio is known.
    """
    ratios = gear_ratios(result.model)
    if not ratios:
        raise DescriptionError(
            f"{result.robot} has no gear ratio; add drive = {{gear_ratio = 100.0}} to its links in"
            " the robot file"
        )
    found = []
    alone = {
        parameter.name: parameter
        for parameter in result.parameters
        if parameter.expression == parameter.name
    }
    for joint, ratio in ratios.items():
        for term in result.base.drive.at(joint).terms:
            for symbol, unit, power in zip(
                term.symbols, term.units(revolute=True), term.powers_of_ratio(), strict=True
            ):
                parameter = alone.get(f"{symbol}{joint + 1}")
                if parameter is None:
                    continue
                shrunk = float(np.abs(ratio) ** power) * (
                    np.sign(ratio) if term.turns_over else 1.0
                )
                found.append(
                    MotorSideParameter(
                        parameter.name,
                        ratio,
                        parameter.estimate,
                        parameter.estimate / shrunk,
                        parameter.std_error / abs(shrunk),
                        unit,
                    )
                )
    return tuple(found)


def gear_ratios(model: RobotModel) -> dict[int, float]:
    """Return the gear ratios that the description gives, by joint (counted from 0)."""
    return {
        k: joint.drive.gear_ratio
        for k, joint in enumerate(model.joints)
        if joint.drive.gear_ratio is not None
    }
