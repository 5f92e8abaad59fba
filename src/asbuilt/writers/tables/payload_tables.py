"""Payload in tables and as a document."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.findings import join_names
from asbuilt.identification import AddedMoments, Payload
from asbuilt.tables import (
    Cell,
    Column,
    Table,
    format_estimate,
    stack_tables,
    wrap_text,
)
from asbuilt.validation.comparison.comparison import tabulate_paired_torques
from asbuilt.validation.verdicts.verdict import describe_payload_outcome

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
    tables = stack_tables((tabulate_payload(payload), tabulate_payload_torques(payload)), full)
    return f"{wrap_text(describe_payload_outcome(payload))}\n\n{tables}"


def tabulate_payload(payload: Payload) -> Table:
    """Return mass, centre of mass and inertia about it, with standard errors."""
    parts = (("noise", payload.noise_errors), ("gains", payload.gain_errors))
    shares = [
        Column(f"of {name}", "", "decimal", 2, of=errors.__getitem__)
        for name, errors in parts
        if np.any(payload.gain_uncertainty > 0.0)
    ]
    projected = (
        "The least-squares estimate is physically inconsistent; this is the nearest consistent one,"
        " and inertias at a bound are unreliable."
    )
    return Table.of(
        range(len(payload.names)),
        _list_columns(payload, UNITS, shares),
        title=f"{payload.robot}: payload at {payload.frame}, {payload.n_samples} samples",
        notes=(*([projected] if payload.projected else []), *_describe_gains(payload)),
        details=(
            f"Centre of mass and inertia in the axes of {payload.frame}; standard errors allow for"
            " residual correlation.",
        ),
    )


def _list_columns(
    found: Payload | AddedMoments, units: Sequence[str], further: Sequence[Column] = ()
) -> tuple[Column, ...]:
    """Return the columns of what is carried: estimate, standard error, percent, determined."""
    values = found.values
    errors = found.std_errors

    def cell(part: int) -> Callable[[int], Cell]:
        return lambda k: (
            format_estimate(values[k], errors[k])[part] if np.isfinite(values[k]) else None
        )

    return (
        Column("parameter", of=lambda k: found.names[k]),
        Column("unit", of=units.__getitem__),
        *(
            Column(head, align="decimal", of=cell(part))
            for part, head in enumerate(("estimate", "std err", "%"))
        ),
        *further,
        Column("determined", of=lambda k: "yes" if found.names[k] in found.determined else "NO"),
    )


def _describe_gains(payload: Payload) -> tuple[str, ...]:
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
    doubted = len(payload.gains_in_doubt)
    every = doubted == len(payload.gain_uncertainty)
    cases = {
        f"Torque gains of {_SOURCES[payload.torque_source]} are taken as known to {spread}"
        f" (standard deviation): they leave {gains:.1f} % of the mass uncertain, most by"
        f" {join_names(leading)},"
        f" noise {noise:.1f} %. A payload of known mass calibrates them (`gains`).": True,
        "GAINS IN DOUBT: no torque agrees in scale with a description that has masses; the"
        " payload has the scale of the torques.": doubted and every,
        f"GAINS IN DOUBT: the gravity torques of {join_names(payload.gains_in_doubt)} are far from"
        " CAD's, which may be the torque scale; the payload's errors allow for it.": doubted
        and not every,
        "The result has no cause data, so the effect of gains on the centre of mass may be"
        " underestimated.": not payload.gains_by_evidence,
    }
    return tuple(note for note, holds in cases.items() if holds)


def tabulate_payload_torques(payload: Payload) -> Table:
    """Return the RMS torque errors with the payload and of the bare arm, a row per joint."""
    pairs = tuple(zip(payload.metrics_bare, payload.metrics, strict=True))
    return tabulate_paired_torques(
        pairs, ("bare arm", "with payload"), [""] * len(pairs[0][0].joint_names)
    )


def payload_document(payload: Payload) -> dict[str, Any]:
    """Return what `asbuilt payload --json` prints, without the files written."""
    values = {
        "estimate": payload.values,
        "std_error": payload.std_errors,
        "std_error_noise": payload.noise_errors,
        "std_error_gains": payload.gain_errors,
    }
    return {
        "robot": payload.robot,
        "frame": payload.frame,
        "frames": {name: placement.tolist() for name, placement in payload.frames.items()},
        "headline": describe_payload_outcome(payload),
        "n_samples": payload.n_samples,
        "mass": {
            **{name: float(value[0]) for name, value in values.items()},
            "slope_by_joint": payload.gain_slopes[0].tolist(),
        },
        "com": {name: value[1:4].tolist() for name, value in values.items()},
        "inertia_about_com": _fill_symmetric(payload.values[4:]),
        "inertia_std_error": _fill_symmetric(payload.std_errors[4:]),
        "inertia_std_error_noise": _fill_symmetric(payload.noise_errors[4:]),
        "inertia_std_error_gains": _fill_symmetric(payload.gain_errors[4:]),
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
        "files": {},
    }


def _fill_symmetric(upper: Array) -> list[list[float]]:
    """Return the symmetric 3 x 3 matrix with these six entries on and above its diagonal."""
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = upper
    return [row.tolist() for row in matrix + np.triu(matrix, 1).T]


def moments_table(found: AddedMoments) -> Table:
    """Return what a weight adds, with standard errors and what is not determined."""
    lost = [
        {"m": "the mass alone"}.get(name, f"the first moment {name}")
        for name in found.not_determined
    ]
    return Table.of(
        range(len(found.names)),
        _list_columns(found, MOMENT_UNITS),
        title=f"{found.robot}: weight on {found.frame}, {found.n_samples} samples",
        notes=(f"This motion does not determine {join_names(lost)}.",) if lost else (),
        details=(f"First moments in the axes of {found.frame}; errors of torque gains scale all.",),
    )


def moments_document(found: AddedMoments) -> dict[str, Any]:
    """Return what `asbuilt payload --moments --json` prints."""
    return {
        "robot": found.robot,
        "frame": found.frame,
        "n_samples": found.n_samples,
        "moments": [
            {"name": name, "unit": unit, "estimate": value, "std_error": error}
            for name, unit, value, error in zip(
                found.names,
                MOMENT_UNITS,
                make_plain(found.values),
                make_plain(found.std_errors),
                strict=True,
            )
        ],
        "determined": list(found.determined),
        "not_determined": list(found.not_determined),
    }
