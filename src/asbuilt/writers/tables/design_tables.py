"""Designed motions and static poses as text and as documents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.dynamics.parameters import parameter_values
from asbuilt.excitation.design.designed_motion import Design, position_of
from asbuilt.excitation.design.static_poses import StaticDesign
from asbuilt.excitation.design_findings import design_findings
from asbuilt.excitation.limits import LimitReport
from asbuilt.findings import Cure, Finding, joined
from asbuilt.tables import WIDTH, Column, Table, numbered, share, significant, wrapped
from asbuilt.writers.files import path_texts
from asbuilt.writers.tables.limit_tables import margin_table, verdict

LISTED = 8
"""Worst determined parameters, or poses, in a short text."""

LARGEST_CONDITION = 1e7
"""Condition number above which its square exceeds double precision."""

Spell = Callable[[Cure | str | None], str]


def static_document(design: StaticDesign, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return the JSON document of static poses."""
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
        "findings": [finding.as_dict() for finding in design_findings(design)],
        "files": path_texts(files),
    }


def excite_document(design: Design, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return the JSON document of a designed motion."""
    bound, findings = design.bound, design_findings(design)
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
            if bound is None
            else bound.upper + design.base.n_base * float(np.log(design.n_samples))
        ),
        "condition_number": design.condition_number,
        "scaled_condition_number": design.scaled_condition_number,
        "worst_margin": design.limits.worst_margin,
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
                design.torque_effects.tolist(),
                strict=True,
            )
        ],
        "durations_tried": [asdict(trial) for trial in design.trials],
        "searches": len(design.candidates),
        "interrupted": design.interrupted,
        "solve_seconds": design.solve_seconds,
        "notes": [finding.message for finding in findings if finding.code != "duration_tried"],
        "findings": [finding.as_dict() for finding in findings],
        "files": path_texts(files),
    }


def excite_text(design: Design, *, full: bool = False, spell: Spell = str) -> str:
    """Return a design as text: limits, worst news, information, margins, worst parameters.

    Parameters
    ----------
    full
        Whether to list all parameters and findings.
    spell
        Returns the text of a cure.
    """
    options, findings = design.options, design_findings(design)
    periods = f" in {options.periods} periods" if (options.periods or 1) > 1 else ""
    title = (
        f"{design.model.name} - {options.parametrisation} motion of {design.motion.duration:g} s,"
        f" {design.size} {design.size_name}{periods}, {design.base.n_base} parameters"
    )
    parameters = parameter_table(design)
    return "\n".join(
        [
            wrapped(title),
            *_verdict(design.limits, findings, spell),
            *(wrapped(text, f"{name:<18} ") for name, text in design_facts(design)),
            "",
            margin_table(design.limits).as_text(full),
            parameters.as_text(full).rstrip(),
            *_notes(findings, full),
        ]
    )


def static_text(design: StaticDesign, *, full: bool = False, spell: Spell = str) -> str:
    """Return static poses as text; arguments of `excite_text`."""
    findings, p = design_findings(design), design.n_parameters
    title = (
        f"{design.model.name} - {len(design.poses)} poses for the {p}"
        f" parameter{'s' if p > 1 else ''} that gravity determines,"
        f" route of {design.route_time:.1f} s"
    )
    condition = f"{design.condition_number:.2f} (scaled {design.scaled_condition_number:.2f})"
    return "\n".join(
        [
            wrapped(title),
            *_verdict(design.limits, findings, spell),
            f"{'log det':<18} {design.log_det:.2f}, found in {design.solve_seconds:.1f} s",
            f"{'condition number':<18} {condition}",
            "",
            pose_table(design).as_text(full),
            margin_table(design.limits).as_text(full).rstrip(),
            *_notes(findings, full),
        ]
    )


def design_facts(design: Design) -> list[tuple[str, str]]:
    """Return name and text of each figure of a design."""
    family, options = design.family_efficiency, design.options
    facts = [
        ("drive terms", f"{design.base.drive}, noise {_listed(design.noise)} N m (N)"),
        ("log det", f"{design.log_det:.2f} for {design.n_samples:g} independent samples"),
    ]
    if options.focus or options.criterion != "d":
        names = joined([name.strip() for name in options.focus]) if options.focus else ""
        facts.insert(0, ("criterion", options.criterion + (f", for {names}" if names else "")))
    if design.d_efficiency is not None:
        known = family is not None and design.family_bound is not design.bound
        own = f"; {share(family)} relative to that for these harmonics" if known else ""
        text = f"{share(design.d_efficiency)} relative to an upper bound that no motion reaches"
        facts.append(("D-efficiency", text + own))
    condition = _condition(design.condition_number, 1)
    scaled = _condition(design.scaled_condition_number, 2)
    facts.append(("condition number", f"{condition} (scaled {scaled})"))
    found = f"best of {len(design.candidates)} local searches in {design.solve_seconds:.1f} s"
    return [*facts, ("search", found)]


def parameter_table(design: Design) -> Table:
    """Return the predicted standard errors, parameters in focus and worst determined ones first."""
    cad = np.array([np.nan if value is None else value for value in _cad(design)])
    errors, effects = design.std_errors, design.torque_effects
    ratio = np.where(np.abs(cad) > 0, errors / np.abs(np.where(cad == 0, 1.0, cad)), np.nan)
    asked = [position_of(design.base, name) for name in design.options.focus]
    worst = np.argsort(-errors * np.sqrt(np.diag(design.mean_information))).tolist()
    order = [*asked, *(i for i in worst if i not in asked)]
    rows = tuple(
        (
            int(design.base.ids[i]),
            design.base.names[i],
            design.base.units[i],
            None if np.isnan(cad[i]) else significant(float(cad[i]), 3),
            significant(float(errors[i]), 2) if np.isfinite(errors[i]) else "undetermined",
            f"{100 * ratio[i]:.1f}" if np.isfinite(ratio[i]) else None,
            f"{100 * effects[i]:.2g}" if np.isfinite(effects[i]) else None,
        )
        for i in order
    )
    heads = (
        Column("id", align="right"),
        Column("parameter"),
        Column("unit"),
        Column("CAD", align="decimal"),
        Column("std err", align="decimal"),
        Column("of CAD", "%", align="decimal"),
        Column("of torque", "%", align="decimal"),
    )
    asked_first = "parameters in focus, then " if asked else ""
    title = f"{asked_first}worst determined parameters, predicted"
    details = ("of torque: torque of one standard error over the torque, both RMS on the motion",)
    listed = tuple(range(min(len(rows), max(LISTED, len(asked)))))
    return Table(heads, rows, title, details=details, important=listed)


def pose_table(design: StaticDesign) -> Table:
    """Return the poses, one row each."""
    names = design.model.joint_names
    if sum(max(len(name), 7) + 2 for name in names) + 4 > WIDTH:
        names = tuple(f"joint {k}" for k in range(1, len(names) + 1))
    heads = (
        Column("pose", align="right"),
        *(
            Column(name, "rad" if joint.is_revolute else "m", "decimal", ".3f")
            for name, joint in zip(names, design.model.joints, strict=True)
        ),
    )
    rows = tuple((k, *pose) for k, pose in enumerate(design.poses.tolist(), 1))
    return Table(heads, rows, important=tuple(range(min(len(rows), LISTED))))


def _verdict(limits: LimitReport, findings: Sequence[Finding], spell: Spell) -> list[str]:
    """Return the verdict and what is wrong."""
    bad = [finding for finding in findings if finding.severity != "info"]
    lines = [verdict(limits)]
    for finding in bad:
        cure = spell(finding.cure) if finding.cure else ""
        lines.append(finding.message + (f"; {cure}" if cure else ""))
    return [wrapped(line) for line in lines]


def _notes(findings: Sequence[Finding], full: bool) -> list[str]:
    notes = [finding.message for finding in findings if finding.severity == "info"]
    return numbered(notes if full else notes[:4])


def _condition(number: float, digits: int) -> str:
    return f"{number:.{digits}f}" if number < LARGEST_CONDITION else f"above {LARGEST_CONDITION:g}"


def _cad(design: Design) -> list[float | None]:
    values = design.base.values(parameter_values(design.model, design.base.drive))
    return [None if np.isnan(value) else float(value) for value in values]


def _listed(values: Any) -> str:
    numbers = [f"{value:.3g}" for value in values]
    return numbers[0] if len(set(numbers)) == 1 else ", ".join(numbers)
