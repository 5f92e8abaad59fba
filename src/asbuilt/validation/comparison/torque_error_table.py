"""Table of RMS torque errors: a row per joint, a column per prediction."""

from __future__ import annotations

from collections.abc import Sequence

from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.tables import Cell, Column, Shown, Table, share

MOST_COLUMNS = 4
"""Predictions in a short text."""


def torque_error_table(
    predictions: Sequence[tuple[str, TorqueMetrics]],
    units: Sequence[str],
    title: str,
    notes: tuple[str, ...] = (),
) -> Table:
    """Return the RMS errors of named predictions joint by joint, and their relative errors.

    Parameters
    ----------
    predictions
        Heads of columns with the errors below.
    units
        Torque unit of each joint.
    title, notes
        Title and notes of the table.
    """
    unit, mixed = ("", True) if len(set(units)) > 1 else (units[0], False)
    heads = (
        Column("joint", width=24),
        *([Column("unit")] if mixed else []),
        *(
            Column(name, unit, "decimal", 3, detail=k >= MOST_COLUMNS)
            for k, (name, _) in enumerate(predictions)
        ),
    )
    rows: list[tuple[Cell, ...]] = [
        (name, *([units[k]] if mixed else []), *(float(e.rms[k]) for _, e in predictions))
        for k, name in enumerate(predictions[0][1].joint_names)
    ]
    relative = (Shown(e.relative_error, share(e.relative_error)) for _, e in predictions)
    rows.append(("relative error", *([""] if mixed else []), *relative))
    return Table(heads, tuple(rows), title=title, notes=notes)
