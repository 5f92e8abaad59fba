"""Results as JSON documents and CSV tables; the field names are what other programs rely on."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.codec import json_text, plain
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.identification.drives.motor_side import gear_ratios, motor_side_parameters
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Cell, Column, Shown, Table, share, significant
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.generalisation.cad_verdict import cad_verdict
from asbuilt.validation.prediction import Validation, torque_units
from asbuilt.validation.verdicts.verdict import Verdict, study_verdict
from asbuilt.workflow.information_efficiency import RecordedInformation
from asbuilt.workflow.study import Study
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.tables.mass_table import exported_masses

MOST_FINDINGS = 12
"""Findings in a document of `identify`, the weightiest; summary.txt and result.json have all."""


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
                "value": plain(value),
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
    result, masses = study.result, exported_masses(study.result)
    findings = study.findings[:MOST_FINDINGS]
    return result.as_dict() | {
        "verdict": plain(study.verdict),
        "drive": str(result.base.drive),
        "errors": plain(result.errors) | {"sentence": result.errors_sentence},
        "motor_side": (
            [asdict(each) for each in motor_side_parameters(result)]
            if gear_ratios(result.model)
            else []
        ),
        "determination": study.determination.as_dict(),
        "mass": None if masses is None else masses.as_dict(),
        "warnings": [{"code": each.code, "message": each.text} for each in findings],
        "findings": plain(findings),
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
        "use": plain(verdict),
        "method": result.method,
        "joints": list(result.joint_names),
        "validation": [validation.metrics_as_built.as_dict() for validation in validations],
        "cad": [validation.metrics_cad.as_dict() for validation in validations],
        "verdict": [cad_verdict(validation).as_dict() for validation in validations],
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
    heads = [Column("recording", width=40)]
    heads += [
        Column(name, unit, "decimal", width=16)
        for name, unit in zip(model.joint_names, torque_units(model), strict=True)
    ]
    heads.append(Column("relative error", align="decimal"))
    rows: list[tuple[Cell, ...]] = [
        (
            recording_name(metrics.source),
            *(Shown(float(value), significant(float(value))) for value in metrics.rms),
            Shown(metrics.relative_error, share(metrics.relative_error)),
        )
        for metrics in errors
    ]
    return Table(tuple(heads), tuple(rows), title=f"RMS torque error of {model.name} as described")


def check_document(
    model: RobotModel,
    checks: Sequence[RecordingCheck],
    carried: Sequence[RecordedInformation | None] = (),
) -> dict[str, Any]:
    """Return what `asbuilt check --json` prints; `information` is None if it was not asked for."""
    parts = list(carried) or [None] * len(checks)
    return {
        "robot": model.name,
        "headline": " ".join(check.headline for check in checks),
        "ok": all(check.ok for check in checks),
        "recordings": [
            {
                "source": check.source,
                "n_samples": check.n_samples,
                "n_joints": check.n_joints,
                "rate": plain(check.rate),
                "duration": check.duration,
                "findings": [asdict(finding) for finding in check.findings],
                "information": None if part is None else part.as_document(),
            }
            for check, part in zip(checks, parts, strict=True)
        ],
    }


def write_json(path: str | os.PathLike[str], document: Any) -> Path:
    """Write a document as JSON."""
    return atomic_write(path, json_text(document))


def identified_table(result: IdentificationResult) -> Table:
    """Return every base parameter of a result in full precision."""
    heads = tuple(
        Column(name)
        for name in (
            "id",
            "name",
            "expression",
            "symbolic",
            "unit",
            "cad",
            "estimate",
            "std_error",
            "determined",
            "dropped",
        )
    )
    return Table(
        heads,
        tuple(
            (
                *(p.id, p.name, p.expression, p.symbolic, p.unit, p.cad, p.estimate, p.std_error),
                "yes" if p.determined else "no",
                "yes" if p.dropped else "no",
            )
            for p in result.parameters
        ),
    )


def write_parameters_csv(path: str | os.PathLike[str], result: IdentificationResult) -> Path:
    """Write the base parameters of a result as CSV.

    Id, name, expression, symbolic, unit, cad, estimate, std_error, determined, dropped; a dropped
    one has no std_error.
    """
    return atomic_write(path, identified_table(result).as_csv())


def prediction_table(validation: Validation) -> Table:
    """Return t and, joint by joint, measured torque and its predictions as built and by design."""
    heads = [Column("t", "s")]
    values = [validation.t]
    for k, (name, unit) in enumerate(zip(validation.joint_names, validation.units, strict=True)):
        for what, torque in (
            ("measured", validation.measured),
            ("as_built", validation.predicted),
            ("cad", validation.predicted_cad),
        ):
            heads.append(Column(f"{name}_{what}", unit))
            values.append(torque[:, k])
    return Table(tuple(heads), tuple(tuple(row) for row in np.column_stack(values).tolist()))
