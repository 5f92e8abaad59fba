"""A designed motion as text and as a document, and its file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.excitation.collision.constraint import skeleton_distance
from asbuilt.excitation.design.design import Design, position_of
from asbuilt.excitation.design.precision import DurationTrial, torque_effects
from asbuilt.excitation.design.static_poses import StaticDesign
from asbuilt.excitation.limits import LimitReport
from asbuilt.excitation.motions.motion import JUMPING, Motion
from asbuilt.tables import Cell, Column, Table, share, significant
from asbuilt.writers.files import path_texts
from asbuilt.writers.motion_files import write_motion

LISTED = 12
"""How many of the worst determined parameters the text names."""

TELLABLE = 1e7
"""Largest condition number of an observation matrix that the product of the matrix with itself
tells.
"""

SAME_POSE = 1e-6
"""Poses that differ by less in every joint [rad or m] are told to be the same."""
UNWATCHED_RATE = 100.0
"""Rate at which the stick figure of a motion that nobody watched is looked at [Hz]."""


def write_design(
    path: str | os.PathLike[str], design: Design | StaticDesign, rate: float
) -> dict[str, Path]:
    """Write the motion, or the one through standing poses, as CSV at `rate` [Hz].

    Returns its path by kind.
    """
    return {"motion": write_motion(path, design.motion, design.model.joint_names, rate)}


def static_document(design: StaticDesign, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt excite --static --json` prints."""
    return {
        "robot": design.model.name,
        "parametrisation": "static",
        "duration": design.motion.duration,
        "n_harmonics": None,
        "n_poses": len(design.poses),
        "n_parameters": design.n_parameters,
        "poses": design.poses.tolist(),
        "joints": list(design.model.joint_names),
        "log_det": design.log_det,
        "d_efficiency": None,
        "condition_number": design.condition_number,
        "scaled_condition_number": design.scaled_condition_number,
        "worst_margin": design.limits.worst_margin,
        "n_turns": design.turns,
        "collision_distance": design.collision_distance,
        "solve_seconds": design.solve_seconds,
        "files": path_texts(files),
    }


def static_text(design: StaticDesign) -> str:
    """Return static poses as a table."""
    head = (
        f"{design.model.name} - {len(design.poses)} poses for the {design.n_parameters}"
        f" {'parameter' if design.n_parameters == 1 else 'parameters'} that gravity tells,"
        f" {design.travel:.1f} s of travel\nlog det {design.log_det:.2f}, condition number"
        f" {design.condition_number:.2f}, scaled {design.scaled_condition_number:.2f}, found in"
        f" {design.solve_seconds:.1f} s\n"
    )
    heads = (
        Column("pose", align="right"),
        *(
            Column(name, "rad" if joint.is_revolute else "m", "decimal", ".4f")
            for name, joint in zip(design.model.joint_names, design.model.joints, strict=True)
        ),
    )
    rows = tuple((k, *pose) for k, pose in enumerate(design.poses.tolist(), 1))
    notes = list(design.notes)
    if design.turns:
        notes.append(
            f"the way turns at {design.turns} further poses, without a rest, to get round what is"
            " watched"
        )
    if design.collision_distance is not None:
        notes.append(
            "smallest distance between bodies, on the way too,"
            f" {1000 * design.collision_distance:.0f} mm"
        )
    else:
        notes.append(_unwatched(design.model, design.motion))
    if np.ptp(design.poses, axis=0).max() < SAME_POSE:
        notes.append(
            "the poses are all the same, for gravity tells the same wherever this robot stands"
        )
    return "\n".join(
        [head, Table(heads, rows).as_text(), _margins(design.limits).as_text(), *_numbered(notes)]
    )


def excite_document(
    design: Design, files: Mapping[str, Path], trials: Sequence[DurationTrial] = ()
) -> dict[str, Any]:
    """Return what `asbuilt excite --json` prints."""
    worst = design.limits.worst_margin
    return {
        "robot": design.model.name,
        "parametrisation": design.options.parametrisation,
        "drive": str(design.base.drive),
        "criterion": design.options.criterion,
        "focus": list(design.options.focus),
        "duration": design.motion.duration,
        "n_harmonics": design.size if design.options.parametrisation == "fourier" else None,
        "size": design.size,
        "periods": design.options.periods or 1,
        "n_parameters": design.base.n_base,
        "log_det": design.log_det,
        "d_efficiency": design.d_efficiency,
        "family_efficiency": design.family_efficiency,
        "log_det_bound": (
            None
            if design.bound is None
            else design.bound.upper + design.base.n_base * float(np.log(design.n_samples))
        ),
        "condition_number": design.condition_number,
        "scaled_condition_number": design.scaled_condition_number,
        "worst_margin": worst,
        "assumed_limits": list(design.assumed),
        "collision_distance": design.collision_distance,
        "noise": design.noise.tolist(),
        "n_samples": design.n_samples,
        "parameters": [
            {
                "id": int(i),
                "name": name,
                "unit": unit,
                "cad": cad,
                "std_error": error if np.isfinite(error) else None,
                "torque_effect": effect if np.isfinite(effect) else None,
            }
            for i, name, unit, cad, error, effect in zip(
                design.base.ids,
                design.base.names,
                design.base.units,
                _cad(design),
                design.std_errors.tolist(),
                torque_effects(design).tolist(),
                strict=True,
            )
        ],
        "durations_tried": [asdict(trial) for trial in trials],
        "searches": len(design.candidates),
        "interrupted": design.interrupted,
        "solve_seconds": design.solve_seconds,
        "notes": [
            *design.notes,
            *(
                [_unwatched(design.model, design.motion)]
                if design.collision_distance is None
                else []
            ),
        ],
        "files": path_texts(files),
    }


def excite_text(design: Design, trials: Sequence[DurationTrial] = ()) -> str:
    """Return a design in words and two small tables."""
    head = (
        f"{design.model.name} - {design.options.parametrisation} motion of"
        f" {design.motion.duration:g} s, {design.size} {design.size_name}{_periods(design)},"
        f" {design.base.n_base} parameters (drive terms {design.base.drive}){_criterion(design)}"
    )
    bound, family = design.d_efficiency, design.family_efficiency
    facts = [
        (
            f"log det {design.log_det:.2f} for {design.n_samples:g} samples, noise"
            f" {_joined(design.noise)} N m (N)"
        ),
        (
            f"D-efficiency {share(bound)} of the bound over all states within the limits"
            if bound is not None
            else ""
        ),
        (
            f"D-efficiency {share(family)} of the bound over motions with these harmonics"
            if family is not None
            else ""
        ),
        (
            f"condition number {_condition(design.condition_number, 1)}, scaled"
            f" {_condition(design.scaled_condition_number, 2)}"
        ),
        f"best of {len(design.candidates)} searches in {design.solve_seconds:.1f} s"
        + (", INTERRUPTED" if design.interrupted else ""),
    ]
    notes = list(design.notes)
    notes += [
        f"{trial.duration:g} s, {trial.size} {design.size_name} in {trial.periods}"
        f" {'period' if trial.periods == 1 else 'periods'} would give a precision of"
        f" {trial.precision:.3g} of the torque"
        for trial in trials
    ]
    if design.motion.parametrisation in JUMPING:
        notes.append("the acceleration jumps; how much jerk that becomes is up to the controller")
    if design.assumed:
        notes.append(
            f"the description gives no limit of {', '.join(design.assumed)} for some joints; those"
            " of MotionBounds.assumed were kept"
        )
    if design.collision_distance is not None:
        notes.append(f"smallest distance between bodies {1000 * design.collision_distance:.0f} mm")
    else:
        notes.append(_unwatched(design.model, design.motion))
    tables = [
        _margins(design.limits).as_text(),
        (
            f"{'what was asked for, then ' if design.options.focus else ''}what is told worst:"
            " predicted standard errors, and what one of them changes of the torque"
        ),
        _errors(design).as_text(),
    ]
    return "\n".join([head, *(fact for fact in facts if fact), "", *tables, *_numbered(notes)])


def _unwatched(model: RobotModel, motion: Motion) -> str:
    """Say that nobody looked for collisions, and whether the stick figure meets itself."""
    told = (
        "NOT CHECKED FOR COLLISIONS with itself, the floor or anything else (--collision,"
        " --tool-box)"
    )
    distance = skeleton_distance(model, motion.at(motion.sample_times(UNWATCHED_RATE))[0])
    if distance is None:
        return told
    meeting = (
        f"runs into itself by {-1000 * distance:.0f} mm"
        if distance < 0
        else f"comes within {1000 * distance:.0f} mm of itself"
    )
    return f"{told}; in capsules, its stick figure {meeting}"


def _criterion(design: Design) -> str:
    if design.options.focus:
        return f", for {', '.join(name.strip() for name in design.options.focus)}"
    return "" if design.options.criterion == "d" else f", criterion {design.options.criterion}"


def _condition(number: float, digits: int) -> str:
    """Return a condition number, which the information tells to half of its digits."""
    return f"{number:.{digits}f}" if number < TELLABLE else f"above {TELLABLE:.0e}"


def _periods(design: Design) -> str:
    count = design.options.periods or 1
    return f" in {count} periods" if count > 1 else ""


def _numbered(notes: Sequence[str]) -> list[str]:
    return [f"[{k}] {note}" for k, note in enumerate(notes, 1)]


def _margins(limits: LimitReport) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for quantity, margin in limits.worst.items():
        if margin is not None:
            rows.append(
                (
                    quantity,
                    margin.joint,
                    margin.time,
                    significant(margin.value, 4),
                    significant(margin.limit, 4),
                    margin.unit,
                    share(margin.margin),
                )
            )
    heads = (
        Column("limit"),
        Column("nearest joint"),
        Column("at", "s", "decimal", ".3f"),
        Column("value", align="decimal"),
        Column("allowed", align="decimal"),
        Column("unit"),
        Column("margin", align="decimal"),
    )
    return Table(heads, tuple(rows))


def _errors(design: Design) -> Table:
    cad, errors = (
        np.array([np.nan if value is None else value for value in _cad(design)]),
        design.std_errors,
    )
    ratio = np.where(np.abs(cad) > 0, errors / np.abs(np.where(cad == 0, 1.0, cad)), np.nan)
    effects = torque_effects(design)
    asked = [position_of(design.base, name) for name in design.options.focus]
    worst = np.argsort(-errors * np.sqrt(np.diag(design.mean_information)))
    order = [*asked, *(i for i in worst.tolist() if i not in asked)][: max(LISTED, len(asked))]
    rows = tuple(
        (
            int(design.base.ids[i]),
            design.base.names[i],
            None if np.isnan(cad[i]) else significant(float(cad[i]), 3),
            significant(float(errors[i]), 2) if np.isfinite(errors[i]) else "not told",
            design.base.units[i],
            share(float(ratio[i])) if np.isfinite(ratio[i]) else None,
            f"{100 * effects[i]:.2g} %" if np.isfinite(effects[i]) else None,
        )
        for i in order
    )
    heads = (
        Column("id", align="right"),
        Column("parameter"),
        Column("CAD", align="decimal"),
        Column("std err", align="decimal"),
        Column("unit"),
        Column("of CAD", align="decimal"),
        Column("of the torque", align="decimal"),
    )
    return Table(heads, rows)


def _cad(design: Design) -> list[float | None]:
    values = design.base.values(parameter_values(design.model, design.base.drive))
    return [None if np.isnan(value) else float(value) for value in values]


def _joined(values: Any) -> str:
    numbers = [f"{value:g}" for value in values]
    return numbers[0] if len(set(numbers)) == 1 else ", ".join(numbers)
