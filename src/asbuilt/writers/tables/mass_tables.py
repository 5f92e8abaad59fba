"""Masses of links: by CAD and as built, and described compared with computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.identification import FeasibleInterval, feasible_intervals
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Column, Table, round_significant
from asbuilt.workflow import LinkMass, LinkMasses
from asbuilt.writers.models.as_built import as_built

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
                {"name": name_place(each)} | _build_mass_document(each) for each in self.links
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
        as_built(result)
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


def feasible_table(intervals: Sequence[FeasibleInterval]) -> Table:
    """List quantities with CAD value, feasible interval, chosen value, and why it is one."""
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


def masses_document(masses: LinkMasses) -> dict[str, Any]:
    """Return mass properties and findings as plain data."""
    return {
        "robot": masses.model.name,
        "links": [
            {
                "name": each.name,
                "origin": each.origin,
                "volume": each.volume,
                "density": each.density,
                "described": _build_body_document(each.described),
                "computed": _build_body_document(each.computed),
            }
            for each in masses.links
        ],
        "findings": [finding.as_dict() for finding in masses.findings],
    }


def _build_body_document(body: LinkInertia | None) -> dict[str, Any] | None:
    if body is None:
        return None
    return {
        "mass": body.mass,
        "com": body.com.tolist(),
        "inertia_about_com": body.inertia_about_com.tolist(),
    }


def masses_table(masses: LinkMasses) -> Table:
    """List mass, centre of mass and moments, described and computed, worst link first."""
    return Table.of(
        masses.links,
        (
            Column("link", of="name"),
            Column("mass", "kg", "decimal", ".4g", of=lambda each: _read_mass(each.described)),
            Column("computed", "kg", "decimal", ".4g", of=lambda each: _read_mass(each.computed)),
            Column("density", "kg/m^3", "right", ".4g", of="density"),
            Column("centre off", "mm", "decimal", ".1f", of=_measure_centre_shift),
            Column("inertia", "computed / file", "right", of=_format_inertia_ratio),
            Column("from", detail=True, of=lambda each: each.origin or None),
            Column(
                "Ixx Iyy Izz in the file",
                "kg m^2",
                detail=True,
                of=lambda each: _format_moments(each.described),
            ),
            Column(
                "Ixx Iyy Izz computed",
                "kg m^2",
                detail=True,
                of=lambda each: _format_moments(each.computed),
            ),
        ),
        f"{masses.model.name}: mass properties described and computed",
        details=(
            "Moments are about the centre of mass; the density is mass over volume of geometry.",
        ),
    )


def _read_mass(body: LinkInertia | None) -> float | None:
    return None if body is None else body.mass


def _measure_centre_shift(link: LinkMass) -> float | None:
    was, now = link.described, link.computed
    return None if was is None or now is None else 1e3 * float(np.linalg.norm(now.com - was.com))


def _format_inertia_ratio(link: LinkMass) -> str | None:
    was, now = link.described, link.computed
    if was is None or now is None:
        return None
    moments = was.principal_moments
    with np.errstate(all="ignore"):
        ratios = now.principal_moments / np.where(moments > 0.0, moments, np.nan)
    return " ".join(f"{value:.2g}" for value in ratios) if np.isfinite(ratios).all() else None


def _format_moments(body: LinkInertia | None) -> str | None:
    if body is None:
        return None
    return " ".join(f"{value:.3g}" for value in np.diag(body.inertia_about_com))
