"""Masses of links: by CAD and as built, and described compared with computed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Column, Table
from asbuilt.writers.models.as_built import as_built


@dataclass(frozen=True, slots=True)
class ExportedMasses:
    """Hold of each link its name, its mass by CAD [kg], None if unknown, and as exported."""

    links: tuple[tuple[str, float | None, float], ...]

    @property
    def total_cad(self) -> float | None:
        """Total mass by CAD [kg]; None if a link's mass is unknown."""
        known = [mass for _, mass, _ in self.links if mass is not None]
        return sum(known) if len(known) == len(self.links) else None

    @property
    def total_as_built(self) -> float:
        """Total mass of the exported robot [kg]."""
        return sum(mass for *_, mass in self.links)

    def as_dict(self) -> dict[str, Any]:
        """Return the masses as plain data."""
        return {
            "cad": self.total_cad,
            "as_built": self.total_as_built,
            "links": [
                {"name": name, "cad": cad, "as_built": built} for name, cad, built in self.links
            ],
        }


@lru_cache(maxsize=4)
def exported_masses(result: IdentificationResult) -> ExportedMasses | None:
    """Return the masses of the links; None if no robot as built can be exported."""
    try:
        model = as_built(result).model
    except (IdentifiabilityError, DescriptionError):
        return None
    return ExportedMasses(
        tuple(
            (
                link.name,
                float(link.inertia.mass) if link.inertia_known else None,
                float(built.inertia.mass),
            )
            for link, built in zip(result.model.links, model.links, strict=True)
            if not link.negligible
        )
    )


def _measure_mass_difference(link: tuple[str, float | None, float | None]) -> float | None:
    """Return how much heavier a link is than CAD [kg]; solvers end within a millionth."""
    _, cad, built = link
    if cad is None or built is None:
        return None
    return 0.0 if abs(built - cad) < 1e-6 * cad else built - cad


def mass_table(masses: ExportedMasses) -> Table:
    """Return the masses link by link with their total."""
    return Table.of(
        [*masses.links, ("total", masses.total_cad, masses.total_as_built)],
        (
            Column("link", width=30, of=lambda each: each[0]),
            Column("CAD", "kg", "decimal", 4, of=lambda each: each[1]),
            Column("as built", "kg", "decimal", 4, of=lambda each: each[2]),
            Column(
                "difference",
                "kg",
                "decimal",
                4,
                of=_measure_mass_difference,
            ),
        ),
        "Masses of the links",
        notes=(
            "As built: links of the exported robot, the closest to CAD within the standard errors."
            " Torques determine combinations of masses, not each mass.",
        ),
    )
