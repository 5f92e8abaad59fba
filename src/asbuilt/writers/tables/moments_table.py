"""First moments of a weight on a link, as a table and as a document."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.findings import joined
from asbuilt.identification.calibration.added_moments import AddedMoments
from asbuilt.tables import Cell, Column, Shown, Table, percent, rounded

UNITS = ("kg m", "kg m", "kg m", "kg")


def moments_table(found: AddedMoments) -> Table:
    """Return what a weight adds, with standard errors and what is not determined."""
    rows: list[tuple[Cell, ...]] = []
    for name, unit, value, error in zip(
        found.names, UNITS, found.values.tolist(), found.std_errors.tolist(), strict=True
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
                found.names, UNITS, found.values.tolist(), found.std_errors.tolist(), strict=True
            )
        ],
        "determined": list(found.determined),
        "not_determined": list(found.not_determined),
    }
