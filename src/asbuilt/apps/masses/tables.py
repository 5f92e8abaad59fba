"""Masses described compared with computed, as tables, documents and descriptions."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.apps.masses.computed_masses import LinkMasses
from asbuilt.apps.masses.mass_findings import LinkMass
from asbuilt.description import LinkInertia
from asbuilt.errors import InertiaError, UsageError
from asbuilt.findings import Cure
from asbuilt.tables import Column, Table
from asbuilt.writers import write_robot_toml, write_urdf


def masses_document(masses: LinkMasses) -> dict[str, Any]:
    """Return mass properties and findings as plain data."""
    return {
        "robot": masses.model.name,
        "links": [
            {
                "name": link.name,
                "origin": link.origin,
                "volume": link.volume,
                "density": link.density,
                "described": _build_body_document(link.described),
                "computed": _build_body_document(link.computed),
            }
            for link in masses.links
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
            Column("mass", "kg", "decimal", ".4g", of=lambda link: _read_mass(link.described)),
            Column("computed", "kg", "decimal", ".4g", of=lambda link: _read_mass(link.computed)),
            Column("density", "kg/m^3", "right", ".4g", of="density"),
            Column("centre off", "mm", "decimal", ".1f", of=_measure_centre_shift),
            Column("inertia", "computed / file", "right", of=_format_inertia_ratio),
            Column("from", detail=True, of=lambda link: link.origin or None),
            Column(
                "Ixx Iyy Izz in the file",
                "kg m^2",
                detail=True,
                of=lambda link: _format_moments(link.described),
            ),
            Column(
                "Ixx Iyy Izz computed",
                "kg m^2",
                detail=True,
                of=lambda link: _format_moments(link.computed),
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
    was = link.described
    now = link.computed
    return None if was is None or now is None else 1e3 * float(np.linalg.norm(now.com - was.com))


def _format_inertia_ratio(link: LinkMass) -> str | None:
    was = link.described
    now = link.computed
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


UNREADABLE = ("missing_mesh", "doubtful_mesh", "mesh_scale", "no_geometry")
"""Findings that say why nothing was computed of a link."""
MOST_REASONS = 3
"""Reasons that an error lists."""


def write_masses(path: str | os.PathLike[str], masses: LinkMasses) -> tuple[Path, tuple[str, ...]]:
    """Write the robot with its computed mass properties: a URDF edited in place, or TOML.

    Returns the path and notes on what the file cannot hold.

    Raises
    ------
    UsageError
        If the suffix is neither .urdf nor .toml, or nothing was computed.
    InertiaError
        If computed mass properties are physically inconsistent.
    """
    place = Path(path)
    model = masses.computed_model
    computed = {link.name: link.computed for link in masses.links if link.computed is not None}
    if not computed:
        reasons = [f.message for f in masses.findings if f.code in UNREADABLE]
        why = f": {'; '.join(reasons[:MOST_REASONS])}" if reasons else ", so there is none to write"
        raise UsageError(
            f"no mass properties were computed{why}",
            cure=Cure("name the folder with the meshes, or repair them", {"meshes": "DIR"})
            if reasons
            else None,
        )
    for name, inertia in computed.items():
        if (reason := inertia.inconsistency()) is not None:
            raise InertiaError(f"computed mass properties of link {name!r}: {reason}", link=name)
    if place.suffix.lower() == ".toml":
        return write_robot_toml(place, model), ()
    if place.suffix.lower() != ".urdf":
        raise UsageError(f"{place} must end in .urdf or .toml")
    original = masses.model.source if masses.model.source.lower().endswith(".urdf") else None
    return write_urdf(place, model, original=original)
