"""Masses of the links by CAD and as built."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Column, Shown, Table, significant
from asbuilt.writers.models.as_built import as_built


@dataclass(frozen=True, slots=True)
class ExportedMasses:
    """Hold the masses of the links [kg] by CAD, None if unknown, and of the exported robot."""

    names: tuple[str, ...]
    cad: tuple[float | None, ...]
    as_built: tuple[float, ...]

    @property
    def total_cad(self) -> float | None:
        """Total mass by CAD [kg]; None if that of a link is unknown."""
        known = [mass for mass in self.cad if mass is not None]
        return sum(known) if len(known) == len(self.cad) else None

    @property
    def total_as_built(self) -> float:
        """Total mass of the exported robot [kg]."""
        return sum(self.as_built)

    @property
    def totals(self) -> tuple[float | None, float]:
        """Total mass by CAD, None if unknown, and of the exported robot [kg]."""
        return self.total_cad, self.total_as_built

    def as_dict(self) -> dict[str, Any]:
        """Return the masses as plain data."""
        return {
            "cad": self.total_cad,
            "as_built": self.total_as_built,
            "links": [
                {"name": name, "cad": cad, "as_built": built}
                for name, cad, built in zip(self.names, self.cad, self.as_built, strict=True)
            ],
        }


@lru_cache(maxsize=4)
def exported_masses(result: IdentificationResult) -> ExportedMasses | None:
    """Return the masses of the links; None if no robot as built can be exported."""
    try:
        model = as_built(result).model
    except (IdentifiabilityError, DescriptionError):
        return None
    pairs = [
        (link, built)
        for link, built in zip(result.model.links, model.links, strict=True)
        if not link.negligible
    ]
    return ExportedMasses(
        names=tuple(link.name for link, _ in pairs),
        cad=tuple(float(link.inertia.mass) if link.inertia_known else None for link, _ in pairs),
        as_built=tuple(float(built.inertia.mass) for _, built in pairs),
    )


def mass_table(masses: ExportedMasses) -> Table:
    """Return the masses link by link with their total."""
    columns = (
        Column("link", width=30),
        *(Column(name, "kg", "decimal") for name in ("CAD", "as built", "difference")),
    )
    entries = [
        *zip(masses.names, masses.cad, masses.as_built, strict=True),
        ("total", masses.total_cad, masses.total_as_built),
    ]
    rows = tuple(
        (
            name,
            *(
                None if value is None else Shown(value, significant(value, 4))
                for value in (cad, built, None if cad is None else built - cad)
            ),
        )
        for name, cad, built in entries
    )
    note = (
        "As built: links of the exported robot, the closest to CAD within the standard errors."
        " Torques determine combinations of masses, not each mass."
    )
    return Table(columns, rows, title="Masses of the links", notes=(note,))
