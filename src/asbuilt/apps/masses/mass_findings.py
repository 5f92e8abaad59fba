"""What is implausible about mass properties of links next to their geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.apps.masses.solids import LinkSolid
from asbuilt.arrays import Array
from asbuilt.description import LinkInertia, check_in_shape, make_link_finding
from asbuilt.findings import SEVERITIES, Cure, Finding


@dataclass(frozen=True, slots=True, eq=False)
class LinkMass:
    """Hold the mass properties of one moving link, in its frame.

    Parameters
    ----------
    name
        Name of the link.
    described
        Mass properties in the description, None if it has none.
    computed
        Mass properties from geometry or table, None if these lack the link.
    origin
        Where `computed` comes from: visual, collision, table, or empty.
    volume
        Volume of the geometry [m^3], NaN if there is none.
    lower, upper
        Corners of the box around the geometry, along the link axes [m], shape (3,).
    """

    name: str
    described: LinkInertia | None
    computed: LinkInertia | None
    origin: str
    volume: float
    lower: Array
    upper: Array

    @property
    def density(self) -> float:
        """Mass in the description over volume of the geometry [kg/m^3], NaN if unknown."""
        return self.described.mass / self.volume if self.described is not None else float("nan")

    @property
    def mass_change(self) -> float:
        """Relative difference of the computed mass to the described mass, NaN if unknown."""
        if self.computed is None or self.described is None or not self.described.mass:
            return float("nan")
        return self.computed.mass / self.described.mass - 1.0

    def __repr__(self) -> str:
        return f"LinkMass({self.name!r}, described={self.described}, computed={self.computed})"


def check_surface(link: str, solid: LinkSolid) -> list[Finding]:
    """Return findings on meshes that are missing, open, unreadable or of doubtful size."""
    findings = [
        make_link_finding(
            "missing_mesh",
            "warning",
            link,
            f"the mesh {name} of {solid.name} was not found or not read",
            Cure("name the folder with the meshes", {"meshes": "DIR"}),
        )
        for name in solid.missing
    ]
    if not solid.has_plausible_size:
        too_large = make_link_finding(
            "mesh_scale",
            "error",
            link,
            f"the {solid.kind} of {solid.name} is {solid.size:.3g} m long",
            Cure('write scale="0.001 0.001 0.001" for a mesh in millimetres'),
        )
        return [*findings, too_large]
    doubts = (f"{solid.kind} of {solid.name}: {doubt}" for doubt in solid.doubts)
    return [
        *findings,
        *(make_link_finding("doubtful_mesh", "warning", link, doubt) for doubt in doubts),
    ]


CHANGE = 0.2
"""Relative difference of a computed mass that is worth a note: a CAD model without cables, grease
and paint differs by less."""


def check_described_mass(link: LinkMass) -> list[Finding]:
    """Return what is implausible about the values of the description, beside the geometry."""
    if link.described is None:
        return [
            make_link_finding(
                "no_inertia", "warning", link.name, "the description gives no inertia"
            )
        ]
    body = link.described
    reason = body.inconsistency()
    findings = []
    if reason is not None:
        findings.append(make_link_finding("inconsistent_inertia", "error", link.name, reason))
    corners = np.array([link.lower, link.upper])
    findings += check_in_shape(link.name, body, link.volume, corners)
    if link.computed is not None and abs(link.mass_change) > CHANGE:
        findings.append(
            make_link_finding(
                "mass_differs",
                "info",
                link.name,
                f"{body.mass:.4g} kg in the description, {link.computed.mass:.4g} kg computed",
            )
        )
    return findings


def sort_by_plausibility(links: list[LinkMass], findings: list[Finding]) -> tuple[LinkMass, ...]:
    """Sort links by their worst finding, then by the change of mass, both descending."""
    worst = {link.name: 3 for link in links}
    for finding in findings:
        if finding.link is not None:
            severity = SEVERITIES.index(finding.severity)
            worst[finding.link] = min(worst[finding.link], severity)
    return tuple(
        sorted(links, key=lambda link: (worst[link.name], -np.nan_to_num(abs(link.mass_change))))
    )
