"""Drive terms in tables."""

from __future__ import annotations

from typing import Any

from asbuilt.dynamics.drives.selection import available_terms
from asbuilt.tables import Column, Table

USE = """\
Terms are chosen as --drive viscous,coulomb,offset; armature is added by default for torques from motors and currents.
Options follow colons: stribeck:velocity=0.05 for all joints, smooth_coulomb:width=0.02/0.01/0.02 one per joint, spring:joints=2/5 at some joints.
An option in brackets that is not stated is fitted to the recording, joint by joint. --drive auto chooses terms on held-out time blocks."""


def drives_document() -> dict[str, Any]:
    """Return the drive terms as plain data."""
    return {
        "drives": [
            {
                "key": term.key,
                "parameters": list(term.letters),
                "formula": term.formula,
                "units": list(term.units(revolute=True)),
                "default_for": list(term.default_for),
                "options": [
                    {"name": s.name, "default": s.default, "lower": s.lower, "upper": s.upper, "unit": s.unit, "fitted": s.fitted}
                    for s in term.shapes
                ],
                "does": (type(term).__doc__ or "").splitlines()[0],
            }
            for term in available_terms().values()
        ]
    }


def drives_text() -> str:
    """Return the drive terms as a table, with how to choose them."""
    rows = []
    for term in available_terms().values():
        options = ", ".join(f"[{s.name} {s.default:g}]" if s.fitted else f"{s.name} {s.default:g}" for s in term.shapes)
        rows.append((term.key, " ".join(term.letters), term.formula, options or "-", ", ".join(term.units(revolute=True))))
    columns = (Column("term"), Column("parameters"), Column("torque"), Column("options"), Column("units"))
    return Table(columns, tuple(rows)).as_text() + "\n" + USE
