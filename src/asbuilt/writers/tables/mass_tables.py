"""Masses of links: by CAD and as built, and described compared with computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.identification import (
    FeasibleInterval,
    as_built_parameters,
    feasible_intervals,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Column, Table, round_significant
from asbuilt.writers.models.as_built import build_robot

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
        total, *masses = feasible_intervals(result, ("mass", *(f"mass:{name}" for name in links)))
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
            Column("feasible", "kg", of=lambda each: each.text.replace(" kg", "")),
            Column("chosen", "kg", "decimal", 4, of="chosen"),
            Column("difference", "kg", "decimal", 4, of=_measure_mass_difference),
        ),
        "Masses of the links",
        notes=(
            "Feasible: least and greatest over all physically consistent robots with these torques"
            " (95 %). Chosen: links of the exported robot, the closest to CAD within the standard"
            " errors.",
        ),
    )


def feasible_table(intervals: Sequence[FeasibleInterval], condition: str = "") -> Table:
    """List quantities with CAD value, feasible interval, chosen value, and why it is one.

    `condition` is what the intervals take as given, as `describe_condition` returns it.
    """
    return Table.of(
        intervals,
        (
            Column("quantity", width=30, of="quantity"),
            Column("CAD", of=lambda each: round_significant(each.cad), align="right"),
            Column("feasible (95 %)", of="text"),
            Column("chosen", of=lambda each: round_significant(each.chosen), align="right"),
            Column("confounded with", width=30, of=_name_confounded),
        ),
        notes=(
            "Feasible: least and greatest over all physically consistent robots with the torques of"
            " these recordings. Chosen: the exported robot, closest to CAD within the standard"
            " errors.",
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
