"""Results as JSON documents and CSV tables, whose names others rely on, and masses of links."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.codec import format_json, make_plain
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, parameter_values
from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.findings import list_warnings
from asbuilt.identification import (
    FeasibleInterval,
    IdentificationResult,
    TorqueMetrics,
    as_built_parameters,
    feasible_intervals,
    gear_ratios,
    motor_side_parameters,
)
from asbuilt.tables import Column, Table, format_share, round_significant
from asbuilt.validation import (
    Validation,
    Verdict,
    cad_verdict,
    recording_name,
    study_verdict,
    torque_units,
)
from asbuilt.workflow import RecordedInformation, Study
from asbuilt.writers.files import path_texts
from asbuilt.writers.models.as_built import build_robot
from asbuilt.writing import atomic_write


def base_document(base: BaseParameters, model: RobotModel) -> dict[str, Any]:
    """Return what `asbuilt base --json` prints; a value is None where the description is silent."""
    values = base.values(parameter_values(model, base.drive))
    return {
        "robot": model.name,
        "drive": str(base.drive),
        "n_standard": base.n_standard,
        "n_base": base.n_base,
        "parameters": [
            {
                "id": int(number),
                "name": name,
                "expression": expression,
                "symbolic": symbolic,
                "value": make_plain(value),
                "unit": unit,
            }
            for number, name, expression, symbolic, value, unit in zip(
                base.ids,
                base.names,
                base.expressions,
                base.symbolic,
                values,
                base.units,
                strict=True,
            )
        ],
        "standard": [
            {
                "id": entry.id,
                "name": entry.name,
                "status": entry.status,
                "in": list(entry.members),
                "why": entry.why,
            }
            for entry in base.standard
        ],
    }


def identify_document(
    study: Study, *, files: Mapping[str, str | os.PathLike[str]] | None = None
) -> dict[str, Any]:
    """Return what `asbuilt identify --json` prints; `files` are the paths written, by kind."""
    result = study.result
    masses = exported_masses(study.result)
    return result.as_dict() | {
        "verdict": make_plain(study.verdict),
        "drive": str(result.base.drive),
        "errors": make_plain(result.errors) | {"sentence": result.errors_sentence},
        "motor_side": (
            [asdict(parameter) for parameter in motor_side_parameters(result)]
            if gear_ratios(result.model)
            else []
        ),
        "determination": study.determination.as_dict(),
        "mass": None if masses is None else masses.as_dict(),
        "warnings": list_warnings(study.findings),
        "findings": make_plain(study.findings),
        "files": path_texts(files),
    }


def validate_document(
    result: IdentificationResult,
    validations: Sequence[Validation],
    *,
    files: Mapping[str, str | os.PathLike[str]] | None = None,
    verdict: Verdict | None = None,
) -> dict[str, Any]:
    """Return what `asbuilt validate --json` prints.

    Metrics as built and of the CAD values on each recording, and the verdict on the model.
    """
    verdict = verdict or study_verdict(result, (), validations)
    return {
        "robot": result.robot,
        "headline": verdict.text,
        "use": make_plain(verdict),
        "method": result.method,
        "joints": list(result.joint_names),
        "validation": [validation.metrics_as_built.as_dict() for validation in validations],
        "cad": [validation.metrics_cad.as_dict() for validation in validations],
        "verdict": [cad_verdict(validation).as_dict() for validation in validations],
        "load": [make_plain(validation.load) for validation in validations],
        "files": path_texts(files),
    }


def described_document(model: RobotModel, errors: Sequence[TorqueMetrics]) -> dict[str, Any]:
    """Return what `asbuilt validate ROBOT --json` prints.

    How far off a robot as described predicts each recording.
    """
    return {
        "robot": model.name,
        "method": "as described",
        "joints": list(model.joint_names),
        "validation": [metrics.as_dict() for metrics in errors],
        "cad": [],
        "files": {},
    }


def described_torque_table(model: RobotModel, errors: Sequence[TorqueMetrics]) -> Table:
    """Return the RMS torque error of each joint of a robot as described, for each recording."""
    columns = (
        Column("recording", width=40),
        *(
            Column(name, unit, "decimal", 3, width=16)
            for name, unit in zip(model.joint_names, torque_units(model), strict=True)
        ),
        Column("relative error", "", "decimal", format_share),
    )
    rows = ((recording_name(e.source), *e.rms.tolist(), e.relative_error) for e in errors)
    return Table(columns, tuple(rows), f"RMS torque error of {model.name} as described")


def check_document(
    model: RobotModel,
    checks: Sequence[RecordingCheck],
    carried: Sequence[RecordedInformation | None] = (),
) -> dict[str, Any]:
    """Return what `asbuilt check --json` prints; `information` is None if it was not asked for."""
    return {
        "robot": model.name,
        "headline": " ".join(check.headline for check in checks),
        "ok": all(check.ok for check in checks),
        "recordings": [
            {
                "source": check.source,
                "n_samples": check.n_samples,
                "n_joints": check.n_joints,
                "rate": make_plain(check.rate),
                "duration": check.duration,
                "findings": [asdict(finding) for finding in check.findings],
                "information": None if part is None else part.as_document(),
            }
            for check, part in zip(checks, carried or [None] * len(checks), strict=True)
        ],
    }


def write_json(path: str | os.PathLike[str], document: Any) -> Path:
    """Write a document as JSON."""
    return atomic_write(path, format_json(document))


def tabulate_identified(result: IdentificationResult) -> Table:
    """Return every base parameter of a result in full precision; a dropped one has no std_error."""
    return Table.of(
        result.parameters,
        (
            *(
                Column(name, of=name)
                for name in (
                    "id",
                    "name",
                    "expression",
                    "symbolic",
                    "unit",
                    "cad",
                    "estimate",
                    "std_error",
                )
            ),
            Column("determined", of=lambda parameter: "yes" if parameter.determined else "no"),
            Column("dropped", of=lambda parameter: "yes" if parameter.dropped else "no"),
        ),
    )


def tabulate_prediction(validation: Validation) -> Table:
    """Return t and, joint by joint, measured torque and its predictions as built and by design."""
    torques = {
        "measured": validation.measured,
        "as_built": validation.predicted,
        "cad": validation.predicted_cad,
    }
    heads = [
        Column(f"{name}_{what}", unit)
        for name, unit in zip(validation.joint_names, validation.units, strict=True)
        for what in torques
    ]
    # Joint by joint: measured, as built, CAD.
    values = np.stack([*torques.values()], axis=2).reshape(len(validation.t), -1)
    rows = np.column_stack([validation.t, values]).tolist()
    return Table((Column("t", "s"), *heads), tuple(map(tuple, rows)))


MOST_NAMED = 3
"""Confounded parameters that a row names."""


@dataclass(frozen=True, slots=True)
class ExportedMasses:
    """Hold the masses of the links and of all together: by CAD, feasible, and as exported."""

    links: tuple[FeasibleInterval, ...]
    total: FeasibleInterval

    def as_dict(self) -> dict[str, Any]:
        """Return the masses as plain data."""
        return _build_mass_document(self.total) | {
            "links": [
                {"name": name_place(link)} | _build_mass_document(link) for link in self.links
            ]
        }


def name_place(interval: FeasibleInterval) -> str:
    """Return the link or joint of a quantity; `total` without one."""
    return interval.quantity.partition(":")[2] or "total"


def _build_mass_document(mass: FeasibleInterval) -> dict[str, Any]:
    known = {key: mass.as_dict()[key] for key in ("cad", "feasible", "chosen")}
    return known | {"as_built": mass.chosen}


@lru_cache(maxsize=4)
def exported_masses(result: IdentificationResult) -> ExportedMasses | None:
    """Return the masses of the links; None if no robot as built can be exported."""
    try:
        build_robot(result, as_built_parameters(result))
        links = [link.name for link in result.model.links if not link.negligible]
        names = "mass", *(f"mass:{name}" for name in links)
        total, *masses = feasible_intervals(result, names, explained=False)
    except (IdentifiabilityError, DescriptionError):
        return None
    return ExportedMasses(tuple(masses), total)


def _measure_mass_difference(mass: FeasibleInterval) -> float | None:
    """Return how much heavier a link is than CAD [kg]; solvers end within a millionth."""
    if mass.cad is None or mass.chosen is None:
        return None
    return 0.0 if abs(mass.chosen - mass.cad) < 1e-6 * mass.cad else mass.chosen - mass.cad


def mass_table(masses: ExportedMasses) -> Table:
    """Return the masses link by link with their total."""
    return Table.of(
        [*masses.links, masses.total],
        (
            Column("link", width=30, of=name_place),
            Column("CAD", "kg", "decimal", 4, of="cad"),
            Column("feasible", "kg", of=lambda interval: interval.text.replace(" kg", "")),
            Column("chosen", "kg", "decimal", 4, of="chosen"),
            Column("difference", "kg", "decimal", 4, of=_measure_mass_difference),
        ),
        "Masses of the links",
        notes=(
            "Feasible: least and greatest over all physically consistent robots with these torques"
            " (95 %). Chosen: links of the exported robot, the closest to CAD within the noise of"
            " the torques.",
        ),
    )


def feasible_table(intervals: Sequence[FeasibleInterval], condition: str = "") -> Table:
    """List quantities with CAD value, feasible interval, chosen value, and why it is one.

    `condition` is what the intervals take as given: `torque_condition` of their result.
    """
    return Table.of(
        intervals,
        (
            Column("quantity", width=30, of="quantity"),
            Column("CAD", of=lambda interval: round_significant(interval.cad), align="right"),
            Column("feasible (95 %)", of="text"),
            Column("chosen", of=lambda interval: round_significant(interval.chosen), align="right"),
            Column("confounded with", width=30, of=_name_confounded),
        ),
        notes=(
            "Feasible: least and greatest over all physically consistent robots with the torques of"
            " these recordings. Chosen: the exported robot, closest to CAD within the noise of"
            " the torques.",
            *([condition] if condition else []),
        ),
    )


def _name_confounded(interval: FeasibleInterval) -> str:
    """Return what takes the place of a quantity, a few names; that it is determined otherwise."""
    if interval.determined:
        return "- (determined)"
    if interval.confounded_with:
        names = interval.confounded_with
        return ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
    if interval.without_effect:
        return f"no torque: {', '.join(interval.without_effect[:MOST_NAMED])}"
    return "-"
