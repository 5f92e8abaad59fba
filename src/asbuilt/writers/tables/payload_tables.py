"""What the flange carries, in print and as a document."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.calibration.payload import Payload
from asbuilt.tables import Column, Shown, Table, percent, rounded, share, significant, stacked
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.writers.files import path_texts

_SOURCES = {
    "motor": "motors",
    "current": "currents",
    "sensor": "sensors",
    "unknown": "an unknown source",
}
UNITS = ("kg", "m", "m", "m", *("kg m^2",) * 6)


def payload_text(payload: Payload) -> str:
    """Return what `asbuilt payload` prints."""
    return stacked((payload_table(payload), payload_torque_table(payload)))


def payload_table(payload: Payload) -> Table:
    """Return mass, centre of mass and inertia about it with standard errors, and whether this
    motion tells them.
    """
    rows = []
    split = bool(np.any(payload.gain_uncertainty > 0.0))
    parts = (payload.values, payload.std_errors, payload.noise_errors, payload.gain_errors)
    for name, unit, value, error, noise, gain in zip(
        payload.names, UNITS, *(each.tolist() for each in parts), strict=True
    ):
        shown, uncertainty = rounded(value, error)
        told = "yes" if name in payload.determined else "NO"
        of_these = (significant(noise, 2), significant(gain, 2)) if split else ()
        rows.append(
            (
                name,
                unit,
                Shown(value, shown),
                Shown(error, uncertainty),
                percent(value, error),
                *of_these,
                told,
            )
        )
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("estimate", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal"),
        *(
            (Column("of noise", align="decimal"), Column("of gains", align="decimal"))
            if split
            else ()
        ),
        Column("told"),
    )
    notes = [
        f"Centre of mass and inertia about it in the axes of {payload.frame}; standard errors allow"
        " for residual correlation."
    ]
    if payload.projected:
        notes.append(
            "The least-squares estimate is impossible for a body; the nearest possible one is given"
            " (inertias at their bound are not to be trusted)."
        )
    notes += _gain_notes(payload)
    return Table(
        columns,
        tuple(rows),
        title=f"{payload.robot}: payload at {payload.frame}, {payload.n_samples} samples",
        notes=tuple(notes),
    )


def _gain_notes(payload: Payload) -> list[str]:
    """Say what gains were taken to be known to, and which of them the mass hangs on."""
    if not np.any(payload.gain_uncertainty > 0.0):
        if payload.torque_source in ("sensor", "unknown"):
            return []
        return [
            f"Torques come from {_SOURCES[payload.torque_source]} whose gains were taken as exact."
        ]
    joints = payload.metrics[0].joint_names
    known = sorted({100.0 * value for value in payload.gain_uncertainty.tolist()})
    spread = f"{known[0]:g} %" if len(known) == 1 else f"{known[0]:.2g} to {known[-1]:.2g} %"
    weight = np.abs(payload.gain_slopes[0] * payload.gain_uncertainty)
    doubt = (
        ""
        if payload.gains_by_evidence
        else (
            " The result kept no cause data, so what gains do to the centre may come out too small."
        )
    )
    leading = [joints[k] for k in np.argsort(-weight)[:3] if weight[k] > 0.25 * weight.max()]
    return [
        f"Torques come from {_SOURCES[payload.torque_source]}, whose gains are known to {spread} at"
        " each joint (standard deviation, a third of the variance common to all;"
        " --gain-uncertainty states another). That leaves"
        f" {100 * payload.gain_errors[0] / payload.values[0]:.1f} % of the mass open, noise"
        f" {100 * payload.noise_errors[0] / payload.values[0]:.1f} %. The mass hangs on the gains"
        f" of {', '.join(leading)}. A payload of known mass calibrates them (asbuilt gains).{doubt}"
    ]


def payload_torque_table(payload: Payload) -> Table:
    """Return the RMS torque error of each joint with the payload and for the bare arm."""
    rows = []
    for bare, carried in zip(payload.metrics_bare, payload.metrics, strict=True):
        rows.append(
            (
                recording_name(bare.source),
                "arm alone",
                *(significant(float(x)) for x in bare.rms),
                share(bare.relative_error),
            )
        )
        rows.append(
            (
                recording_name(carried.source),
                "with payload",
                *(significant(float(x)) for x in carried.rms),
                share(carried.relative_error),
            )
        )
    names = payload.metrics[0].joint_names
    columns = (
        Column("recording", width=60),
        Column("prediction"),
        *(Column(name, align="decimal", width=16) for name in names),
        Column("relative error", align="decimal"),
    )
    return Table(columns, tuple(rows), title="RMS torque error")


def payload_document(payload: Payload, files: Mapping[str, Path] | None = None) -> dict[str, Any]:
    """Return what `asbuilt payload --json` prints."""
    errors, noise, gain = (
        _symmetric(each[4:])
        for each in (payload.std_errors, payload.noise_errors, payload.gain_errors)
    )
    return {
        "robot": payload.robot,
        "frame": payload.frame,
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
        "physically_consistent": payload.inertia.is_consistent,
        "projected": payload.projected,
        "determined": list(payload.determined),
        "not_determined": list(payload.not_determined),
        "validation": [metrics.as_dict() for metrics in payload.metrics],
        "bare": [metrics.as_dict() for metrics in payload.metrics_bare],
        "files": path_texts(files),
    }


def _symmetric(upper: Array) -> list[list[float]]:
    """Return the symmetric 3 x 3 matrix with these six entries on and above its diagonal, row by
    row.
    """
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = upper
    return [row.tolist() for row in matrix + np.triu(matrix, 1).T]
