"""Mass properties of links in tables: those of the description beside those computed."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.tables import Cell, Column, Table
from asbuilt.workflow.masses.link_masses import LinkMasses
from asbuilt.workflow.masses.mass_findings import LinkMass


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
                "described": _body_document(each.described),
                "computed": _body_document(each.computed),
            }
            for each in masses.links
        ],
        "findings": [finding.as_dict() for finding in masses.findings],
    }


def _body_document(body: LinkInertia | None) -> dict[str, Any] | None:
    if body is None:
        return None
    return {
        "mass": body.mass,
        "com": body.com.tolist(),
        "inertia_about_com": body.inertia_about_com.tolist(),
    }


def masses_table(masses: LinkMasses) -> Table:
    """List mass, centre of mass and moments, description beside computed, worst link first."""
    columns = (
        Column("link"),
        Column("mass", "kg", "decimal", ".4g"),
        Column("computed", "kg", "decimal", ".4g"),
        Column("density", "kg/m^3", "right", ".4g"),
        Column("centre off", "mm", "decimal", ".1f"),
        Column("inertia", "computed / file", "right"),
        Column("from", detail=True),
        Column("Ixx Iyy Izz in the file", "kg m^2", detail=True),
        Column("Ixx Iyy Izz computed", "kg m^2", detail=True),
    )
    title = f"{masses.model.name}: mass properties of the description beside those computed"
    details = (
        "Moments are about the centre of mass; the density is mass over volume of geometry.",
    )
    return Table(columns, tuple(map(_row, masses.links)), title=title, details=details)


def _row(link: LinkMass) -> tuple[Cell, ...]:
    was, now = link.described, link.computed
    off = ratio = None
    if was is not None and now is not None:
        off = 1e3 * float(np.linalg.norm(now.com - was.com))
        moments = was.principal_moments
        with np.errstate(all="ignore"):
            ratios = now.principal_moments / np.where(moments > 0.0, moments, np.nan)
        ratio = " ".join(f"{value:.2g}" for value in ratios) if np.isfinite(ratios).all() else None
    return (
        link.name,
        None if was is None else was.mass,
        None if now is None else now.mass,
        link.density,
        off,
        ratio,
        link.origin or None,
        _moments(was),
        _moments(now),
    )


def _moments(body: LinkInertia | None) -> str | None:
    if body is None:
        return None
    return " ".join(f"{value:.3g}" for value in np.diag(body.inertia_about_com))
