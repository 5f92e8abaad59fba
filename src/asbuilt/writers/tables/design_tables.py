"""Designed motions and static poses, and the margins of motions, as text and as documents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.codec import make_plain
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.excitation import LimitReport, StaticDesign, design_findings
from asbuilt.excitation.design.designed_motion import Design, locate_base_parameter
from asbuilt.findings import Cure, join_names
from asbuilt.tables import (
    WIDTH,
    Column,
    Table,
    format_share,
    number_notes,
    round_significant,
    wrap_text,
)
from asbuilt.writers.files import path_texts

LISTED = 8
"""Worst determined parameters, or poses, in a short text."""

LARGEST_CONDITION = 1e7
"""Condition number above which its square exceeds double precision."""

Spell = Callable[[Cure | str | None], str]


def design_document(design: Design | StaticDesign, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return the JSON document of a designed motion or of static poses."""
    return {
        "robot": design.model.name,
        "duration": design.motion.duration,
        "log_det": design.log_det,
        "condition_number": design.condition_number,
        "scaled_condition_number": design.scaled_condition_number,
        "worst_margin": design.limits.worst_margin,
        "collision_distance": design.collision_distance,
        "solve_seconds": design.solve_seconds,
        **_build_own_document(design),
        "findings": [finding.as_dict() for finding in design_findings(design)],
        "files": path_texts(files),
    }


def _build_own_document(design: Design | StaticDesign) -> dict[str, Any]:
    """Return what only motions or only poses have."""
    if isinstance(design, StaticDesign):
        return {
            "parametrisation": "static",
            "n_harmonics": None,
            "n_poses": len(design.poses),
            "n_parameters": design.n_parameters,
            "poses": design.poses.tolist(),
            "joints": list(design.model.joint_names),
            "d_efficiency": None,
            "n_turns": design.turns,
        }
    bound = design.bound
    base = design.base
    options = design.options
    columns = {
        "id": base.ids,
        "name": base.names,
        "unit": base.units,
        "cad": base.values(parameter_values(design.model, base.drive)),
        "std_error": design.std_errors,
        "torque_effect": design.torque_effects,
    }
    rows = zip(*map(make_plain, columns.values()), strict=True)
    return {
        "parametrisation": options.parametrisation,
        "drive": str(base.drive),
        "criterion": options.criterion,
        "focus": list(options.focus),
        "n_harmonics": design.size if options.parametrisation == "fourier" else None,
        "size": design.size,
        "periods": options.periods or 1,
        "n_parameters": base.n_base,
        "d_efficiency": design.d_efficiency,
        "family_efficiency": design.family_efficiency,
        "log_det_bound": (
            None if bound is None else bound.upper + base.n_base * float(np.log(design.n_samples))
        ),
        "assumed_limits": list(design.assumed),
        "noise": design.noise.tolist(),
        "n_samples": design.n_samples,
        "parameters": [dict(zip(columns, row, strict=True)) for row in rows],
        "durations_tried": [asdict(trial) for trial in design.trials],
        "searches": len(design.candidates),
        "interrupted": design.interrupted,
        "notes": [
            finding.message
            for finding in design_findings(design)
            if finding.code != "duration_tried"
        ],
    }


def design_text(design: Design | StaticDesign, *, full: bool = False, spell: Spell = str) -> str:
    """Return a design as text: limits, worst news, information, margins, and its main table.

    Parameters
    ----------
    full
        Whether to list all parameters, or poses, and findings.
    spell
        Returns the text of a cure.
    """
    findings = design_findings(design)
    notes = [finding.message for finding in findings if finding.severity == "info"]
    bad = [
        finding.message + (f"; {spell(finding.cure)}" if finding.cure else "")
        for finding in findings
        if finding.severity != "info"
    ]
    return "\n".join(
        [
            wrap_text(f"{design.model.name} - {design_title(design)}"),
            *map(wrap_text, (describe_margins(design.limits), *bad)),
            *(wrap_text(text, f"{name:<18} ") for name, text in design_facts(design)),
            "",
            tabulate_margins(design.limits).as_text(full),
            design_table(design).as_text(full).rstrip(),
            *number_notes(notes if full else notes[:4]),
        ]
    )


def design_title(design: Design | StaticDesign) -> str:
    """Return what was designed."""
    if isinstance(design, StaticDesign):
        return (
            f"{len(design.poses)} poses for the {design.n_parameters}"
            f" parameter{'s' if design.n_parameters > 1 else ''} that gravity determines,"
            f" route of {design.route_time:.1f} s"
        )
    options = design.options
    periods = f" in {options.periods} periods" if (options.periods or 1) > 1 else ""
    return (
        f"{options.parametrisation} motion of {design.motion.duration:g} s,"
        f" {design.size} {design.size_name}{periods}, {design.base.n_base} parameters"
    )


def design_facts(design: Design | StaticDesign) -> list[tuple[str, str]]:
    """Return name and text of each figure of a design."""
    if isinstance(design, StaticDesign):
        condition = f"{design.condition_number:.2f} (scaled {design.scaled_condition_number:.2f})"
        found = f"{design.log_det:.2f}, found in {design.solve_seconds:.1f} s"
        return [("log det", found), ("condition number", condition)]
    family = design.family_efficiency
    options = design.options
    names = join_names([name.strip() for name in options.focus])
    criterion = options.criterion + (f", for {names}" if names else "")
    facts = [
        *([("criterion", criterion)] if criterion != "d" else []),
        ("drive terms", f"{design.base.drive}, noise {_format_numbers(design.noise)} N m (N)"),
        ("log det", f"{design.log_det:.2f} for {design.n_samples:g} independent samples"),
    ]
    if design.d_efficiency is not None:
        known = family is not None and design.family_bound is not design.bound
        own = f"; {format_share(family)} relative to that for these harmonics" if known else ""
        text = (
            f"{format_share(design.d_efficiency)} relative to an upper bound that no motion reaches"
        )
        facts.append(("D-efficiency", text + own))
    condition = _format_condition(design.condition_number, 1)
    scaled = _format_condition(design.scaled_condition_number, 2)
    found = f"best of {len(design.candidates)} local searches in {design.solve_seconds:.1f} s"
    return [*facts, ("condition number", f"{condition} (scaled {scaled})"), ("search", found)]


def design_table(design: Design | StaticDesign) -> Table:
    """Return the poses, or the predicted standard errors of a designed motion.

    Parameters in focus and worst determined ones are first.
    """
    if isinstance(design, StaticDesign):
        return _build_pose_table(design)
    base = design.base
    errors = design.std_errors
    effects = design.torque_effects
    cad = base.values(parameter_values(design.model, base.drive))
    ratio = np.where(np.abs(cad) > 0, errors / np.abs(np.where(cad == 0, 1.0, cad)), np.nan)
    asked = [locate_base_parameter(base, name) for name in design.options.focus]
    worst = np.argsort(-errors * np.sqrt(np.diag(design.mean_information))).tolist()
    order = [*asked, *(i for i in worst if i not in asked)]
    return Table.of(
        order,
        (
            Column("id", align="right", of=lambda i: int(base.ids[i])),
            Column("parameter", of=lambda i: base.names[i]),
            Column("unit", of=lambda i: base.units[i]),
            Column("CAD", align="decimal", style=3, of=lambda i: cad[i]),
            Column(
                "std err",
                align="decimal",
                of=lambda i: (
                    round_significant(errors[i], 2) if np.isfinite(errors[i]) else "undetermined"
                ),
            ),
            Column("of CAD", "%", "decimal", ".1f", of=lambda i: 100 * ratio[i]),
            Column("of torque", "%", "decimal", ".2g", of=lambda i: 100 * effects[i]),
        ),
        f"{'parameters in focus, then ' if asked else ''}worst determined parameters, predicted",
        details=(
            "of torque: torque of one standard error over the torque, both RMS on the motion",
        ),
        important=tuple(range(min(len(order), max(LISTED, len(asked))))),
    )


def _build_pose_table(design: StaticDesign) -> Table:
    """Return the poses, one row each."""
    names = design.model.joint_names
    if sum(max(len(name), 7) + 2 for name in names) + 4 > WIDTH:
        names = tuple(f"joint {k}" for k in range(1, len(names) + 1))
    heads = [
        Column(name, joint.unit, "decimal", ".3f")
        for name, joint in zip(names, design.model.joints, strict=True)
    ]
    rows = tuple((k, *pose) for k, pose in enumerate(design.poses.tolist(), 1))
    return Table(
        (Column("pose", align="right"), *heads),
        rows,
        important=tuple(range(min(len(rows), LISTED))),
    )


def describe_margins(limits: LimitReport) -> str:
    """Return whether the limits are kept, and the smallest margin."""
    margins = [margin for margin in limits.worst.values() if margin is not None]
    if not margins:
        return "NO LIMITS: the description gives none"
    worst = min(margins, key=lambda margin: margin.margin)
    place = f"{worst.quantity} of {worst.joint} at {worst.time:.2f} s"
    if limits.violations:
        return f"LIMITS VIOLATED: margin {format_share(worst.margin)}, {place}"
    return f"limits kept, smallest margin {format_share(worst.margin)} ({place})"


def tabulate_margins(limits: LimitReport) -> Table:
    """Return the smallest margin of each quantity, with its joint and time."""
    return Table.of(
        [margin for margin in limits.worst.values() if margin is not None],
        (
            Column("limit", of="quantity"),
            Column("nearest joint", width=24, of="joint"),
            Column("time", "s", "decimal", ".3f", of="time"),
            Column("value", align="decimal", style=4, of="value"),
            Column("allowed", align="decimal", style=4, of="limit"),
            Column("unit", of="unit"),
            Column("margin", "%", "decimal", ".1f", of=lambda margin: 100 * margin.margin),
        ),
    )


def _format_condition(number: float, digits: int) -> str:
    return f"{number:.{digits}f}" if number < LARGEST_CONDITION else f"above {LARGEST_CONDITION:g}"


def _format_numbers(values: Any) -> str:
    numbers = [f"{value:.3g}" for value in values]
    return numbers[0] if len(set(numbers)) == 1 else ", ".join(numbers)
