"""What the flange carries, in print and as a document."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.identification.payload import Payload
from asbuilt.tables import Column, Shown, Table, percent, rounded, significant, stacked

UNITS = ("kg", "m", "m", "m", *("kg m^2",) * 6)


def payload_text(payload: Payload) -> str:
    """Return what `asbuilt payload` prints."""
    return stacked((payload_table(payload), payload_torque_table(payload)))


def payload_table(payload: Payload) -> Table:
    """Return mass, centre of mass and inertia about it with standard errors, and whether this motion tells them."""
    rows = []
    for name, unit, value, error in zip(payload.names, UNITS, payload.values, payload.std_errors, strict=True):
        shown, uncertainty = rounded(float(value), float(error))
        told = "yes" if name in payload.determined else "NO"
        rows.append((name, unit, Shown(float(value), shown), Shown(float(error), uncertainty), percent(float(value), float(error)), told))
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("estimate", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal"),
        Column("told by this motion"),
    )
    notes = [f"Centre of mass and inertia about it in the axes of {payload.frame}; standard errors allow for residual correlation."]
    if payload.projected:
        notes.append(
            "The least-squares estimate is impossible for a body; the nearest possible one is given (inertias at their bound are not to be trusted)."
        )
    if payload.torque_source == "current":
        notes.append(
            "Torques come from currents: an error of the gains carries over to the mass in proportion and is not in its standard error."
        )
    return Table(
        columns, tuple(rows), title=f"{payload.robot}: payload at {payload.frame}, {payload.n_samples} samples", notes=tuple(notes)
    )


def payload_torque_table(payload: Payload) -> Table:
    """Return the RMS torque error of each joint with the payload and for the bare arm."""
    rows = []
    for bare, carried in zip(payload.metrics_bare, payload.metrics, strict=True):
        rows.append((Path(bare.source).name, "arm alone", *(significant(float(x)) for x in bare.rms), significant(bare.relative_error)))
        rows.append(
            (Path(carried.source).name, "with payload", *(significant(float(x)) for x in carried.rms), significant(carried.relative_error))
        )
    names = payload.metrics[0].joint_names
    columns = (
        Column("recording", width=40),
        Column("prediction"),
        *(Column(name, align="decimal", width=16) for name in names),
        Column("relative", align="decimal"),
    )
    return Table(columns, tuple(rows), title="RMS torque error")


def payload_document(payload: Payload, files: Mapping[str, Path] | None = None) -> dict[str, Any]:
    """Return what `asbuilt payload --json` prints."""
    about = np.zeros((3, 3))
    about[np.triu_indices(3)] = payload.values[4:]
    errors = np.zeros((3, 3))
    errors[np.triu_indices(3)] = payload.std_errors[4:]
    return {
        "robot": payload.robot,
        "frame": payload.frame,
        "n_samples": payload.n_samples,
        "mass": {"estimate": float(payload.values[0]), "std_error": float(payload.std_errors[0])},
        "com": {"estimate": payload.values[1:4].tolist(), "std_error": payload.std_errors[1:4].tolist()},
        "inertia_about_com": (about + np.triu(about, 1).T).tolist(),
        "inertia_std_error": (errors + np.triu(errors, 1).T).tolist(),
        "physically_consistent": payload.inertia.is_consistent,
        "projected": payload.projected,
        "determined": list(payload.determined),
        "not_determined": list(payload.not_determined),
        "validation": [metrics.as_dict() for metrics in payload.metrics],
        "bare": [metrics.as_dict() for metrics in payload.metrics_bare],
        "files": {kind: str(path) for kind, path in (files or {}).items()},
    }
