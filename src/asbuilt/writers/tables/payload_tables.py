"""Payload in tables and as a document."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.findings import joined
from asbuilt.identification.calibration.added_moments import AddedMoments
from asbuilt.identification.calibration.payload import Payload
from asbuilt.tables import (
    Cell,
    Column,
    Shown,
    Table,
    percent,
    plus_minus,
    rounded,
    significant,
    stacked,
    wrapped,
)
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.comparison.torque_error_table import torque_error_table
from asbuilt.writers.files import path_texts

_SOURCES = {
    "motor": "motors",
    "current": "currents",
    "sensor": "sensors",
    "unknown": "an unknown source",
}
UNITS = ("kg", "m", "m", "m", *("kg m^2",) * 6)
MOMENT_UNITS = ("kg m", "kg m", "kg m", "kg")


def payload_text(payload: Payload, full: bool = False) -> str:
    """Return what `asbuilt payload` prints."""
    tables = stacked((payload_table(payload), payload_torque_table(payload)), full)
    return f"{wrapped(payload_headline(payload))}\n\n{tables}"


def payload_headline(payload: Payload) -> str:
    """Return what a user decides by: what the flange carries, in a sentence with its errors."""
    values, errors = payload.values.tolist(), payload.std_errors.tolist()
    mass = plus_minus(values[0], errors[0])
    if "mass" not in payload.determined:
        return f"Payload at {payload.frame}: its mass is undetermined ({mass} kg)."
    known = [k for k in (1, 2, 3) if payload.names[k] in payload.determined]
    centre = ", ".join(f"{'xyz'[k - 1]} {plus_minus(values[k], errors[k])}" for k in known)
    where = f"{centre} m" if centre else "undetermined"
    return f"Payload at {payload.frame}: {mass} kg, its centre {where}."


def payload_table(payload: Payload) -> Table:
    """Return mass, centre of mass and inertia about it, with standard errors."""
    split = bool(np.any(payload.gain_uncertainty > 0.0))
    parts = (payload.values, payload.std_errors, payload.noise_errors, payload.gain_errors)
    rows = []
    for name, unit, value, error, noise, gain in zip(
        payload.names, UNITS, *(each.tolist() for each in parts), strict=True
    ):
        shown, uncertainty = rounded(value, error)
        rows.append(
            (
                name,
                unit,
                Shown(value, shown),
                Shown(error, uncertainty),
                percent(value, error),
                *((significant(noise, 2), significant(gain, 2)) if split else ()),
                "yes" if name in payload.determined else "NO",
            )
        )
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("estimate", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal"),
        *((Column(f"of {part}", align="decimal") for part in ("noise", "gains")) if split else ()),
        Column("determined"),
    )
    projected = (
        "The least-squares estimate is physically inconsistent; this is the nearest consistent one,"
        " and inertias at a bound are unreliable."
    )
    return Table(
        columns,
        tuple(rows),
        title=f"{payload.robot}: payload at {payload.frame}, {payload.n_samples} samples",
        notes=(*([projected] if payload.projected else []), *_gain_notes(payload)),
        details=(
            f"Centre of mass and inertia in the axes of {payload.frame}; standard errors allow for"
            " residual correlation.",
        ),
    )


def _gain_notes(payload: Payload) -> tuple[str, ...]:
    """Return how well the torque gains are known, and what follows for the mass."""
    if not np.any(payload.gain_uncertainty > 0.0):
        if payload.torque_source in ("sensor", "unknown"):
            return ()
        return (f"Torque gains of {_SOURCES[payload.torque_source]} are taken as exact.",)
    joints = payload.metrics[0].joint_names
    known = sorted({100.0 * value for value in payload.gain_uncertainty.tolist()})
    spread = f"{known[0]:g} %" if len(known) == 1 else f"{known[0]:.2g} to {known[-1]:.2g} %"
    weight = np.abs(payload.gain_slopes[0] * payload.gain_uncertainty)
    leading = [joints[k] for k in np.argsort(-weight)[:3] if weight[k] > 0.25 * weight.max()]
    noise, gains = (
        100 * errors[0] / payload.values[0]
        for errors in (payload.noise_errors, payload.gain_errors)
    )
    known_by = (
        ()
        if payload.gains_by_evidence
        else (
            "The result has no cause data, so the effect of gains on the centre of mass may be"
            " underestimated.",
        )
    )
    return (
        f"Torque gains of {_SOURCES[payload.torque_source]} are taken as known to {spread}"
        f" (standard deviation): they leave {gains:.1f} % of the mass uncertain, most by"
        f" {joined(leading)},"
        f" noise {noise:.1f} %. A payload of known mass calibrates them (`gains`).",
        *_doubts(payload),
        *known_by,
    )


def _doubts(payload: Payload) -> tuple[str, ...]:
    """Return which gains are doubted, since gravity torques are far from those of CAD."""
    if not payload.gains_in_doubt:
        return ()
    if len(payload.gains_in_doubt) == len(payload.gain_uncertainty):
        return (
            "GAINS IN DOUBT: no torque agrees in scale with a description that has masses; the"
            " payload has the scale of the torques.",
        )
    return (
        f"GAINS IN DOUBT: the gravity torques of {joined(payload.gains_in_doubt)} are far from"
        " those of CAD, which may be the torque scale; the payload's errors allow for it.",
    )


def payload_torque_table(payload: Payload) -> Table:
    """Return the RMS torque errors with the payload and of the bare arm, a row per joint."""
    number = [
        f" [{k + 1}]" if len(payload.metrics) > 1 else "" for k in range(len(payload.metrics))
    ]
    named = [
        (f"{what}{number[k]}", metrics)
        for k, pair in enumerate(zip(payload.metrics_bare, payload.metrics, strict=True))
        for what, metrics in zip(("bare arm", "with payload"), pair, strict=True)
    ]
    units = [""] * len(payload.metrics[0].joint_names)
    sources = tuple(recording_name(carried.source) for carried in payload.metrics)
    if len(sources) == 1:
        return torque_error_table(named, units, f"RMS torque error on {sources[0]}")
    return torque_error_table(named, units, "RMS torque error", sources)


def payload_document(payload: Payload, files: Mapping[str, Path] | None = None) -> dict[str, Any]:
    """Return what `asbuilt payload --json` prints."""
    errors, noise, gain = (
        _symmetric(each[4:])
        for each in (payload.std_errors, payload.noise_errors, payload.gain_errors)
    )
    return {
        "robot": payload.robot,
        "frame": payload.frame,
        "headline": payload_headline(payload),
        "n_samples": payload.n_samples,
        "mass": {
            "estimate": float(payload.values[0]),
            "std_error": float(payload.std_errors[0]),
            "std_error_noise": float(payload.noise_errors[0]),
            "std_error_gains": float(payload.gain_errors[0]),
            "slope_by_joint": payload.gain_slopes[0].tolist(),
        },
        "com": {
            "estimate": payload.values[1:4].tolist(),
            "std_error": payload.std_errors[1:4].tolist(),
            "std_error_noise": payload.noise_errors[1:4].tolist(),
            "std_error_gains": payload.gain_errors[1:4].tolist(),
        },
        "inertia_about_com": _symmetric(payload.values[4:]),
        "inertia_std_error": errors,
        "inertia_std_error_noise": noise,
        "inertia_std_error_gains": gain,
        "torque_source": payload.torque_source,
        "gain_uncertainty": payload.gain_uncertainty.tolist(),
        "gains_by_evidence": payload.gains_by_evidence,
        "gains_in_doubt": list(payload.gains_in_doubt),
        "physically_consistent": payload.inertia.is_consistent,
        "projected": payload.projected,
        "determined": list(payload.determined),
        "not_determined": list(payload.not_determined),
        "validation": [metrics.as_dict() for metrics in payload.metrics],
        "bare": [metrics.as_dict() for metrics in payload.metrics_bare],
        "files": path_texts(files),
    }


def _symmetric(upper: Array) -> list[list[float]]:
    """Return the symmetric 3 x 3 matrix with these six entries on and above its diagonal."""
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = upper
    return [row.tolist() for row in matrix + np.triu(matrix, 1).T]


def moments_table(found: AddedMoments) -> Table:
    """Return what a weight adds, with standard errors and what is not determined."""
    rows: list[tuple[Cell, ...]] = []
    for name, unit, value, error in zip(
        found.names, MOMENT_UNITS, found.values.tolist(), found.std_errors.tolist(), strict=True
    ):
        well = "yes" if name in found.determined else "NO"
        if not np.isfinite(value):
            rows.append((name, unit, None, None, None, well))
            continue
        shown, uncertainty = rounded(value, error)
        cells = Shown(value, shown), Shown(error, uncertainty), percent(value, error)
        rows.append((name, unit, *cells, well))
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("estimate", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal"),
        Column("determined"),
    )
    lost = [
        {"m": "the mass alone"}.get(name, f"the first moment {name}")
        for name in found.not_determined
    ]
    return Table(
        columns,
        tuple(rows),
        title=f"{found.robot}: weight on {found.frame}, {found.n_samples} samples",
        notes=(f"This motion does not determine {joined(lost)}.",) if lost else (),
        details=(f"First moments in the axes of {found.frame}; errors of torque gains scale all.",),
    )


def moments_document(found: AddedMoments) -> dict[str, Any]:
    """Return what `asbuilt payload --moments --json` prints."""
    return {
        "robot": found.robot,
        "frame": found.frame,
        "n_samples": found.n_samples,
        "moments": [
            {
                "name": name,
                "unit": unit,
                "estimate": value if np.isfinite(value) else None,
                "std_error": error if np.isfinite(error) else None,
            }
            for name, unit, value, error in zip(
                found.names,
                MOMENT_UNITS,
                found.values.tolist(),
                found.std_errors.tolist(),
                strict=True,
            )
        ],
        "determined": list(found.determined),
        "not_determined": list(found.not_determined),
    }
