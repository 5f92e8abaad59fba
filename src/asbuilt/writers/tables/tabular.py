"""Results as JSON documents and CSV tables; the field names are what other programs rely on."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.codec import format_json, make_plain
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, parameter_values
from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.identification import (
    IdentificationResult,
    TorqueMetrics,
    gear_ratios,
    motor_side_parameters,
)
from asbuilt.tables import Column, Table, format_share
from asbuilt.validation import (
    Validation,
    Verdict,
    cad_verdict,
    recording_name,
    study_verdict,
    torque_units,
)
from asbuilt.workflow import RecordedInformation, Study
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.tables.mass_tables import exported_masses


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
        "warnings": [{"code": finding.code, "message": finding.text} for finding in study.findings],
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
            Column("determined", of=lambda each: "yes" if each.determined else "no"),
            Column("dropped", of=lambda each: "yes" if each.dropped else "no"),
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
