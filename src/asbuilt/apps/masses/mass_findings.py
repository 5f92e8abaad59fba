"""What is implausible about mass properties of links: densities, inertias, copies, surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from asbuilt.apps.masses.cad.meshes import PLAUSIBLE_SIZE
from asbuilt.apps.masses.cad.solids import LinkSolid
from asbuilt.arrays import Array
from asbuilt.description import LinkInertia
from asbuilt.findings import SEVERITIES, Cure, Finding


@dataclass(frozen=True, slots=True)
class Plausibility:
    """Thresholds of mass properties."""

    lightest: float = 100.0
    """Density [kg/m^3] of a hollow housing with thin walls; foam and balsa are lighter."""
    heaviest: float = 20000.0
    """Density [kg/m^3] above tungsten's, 19300."""
    equal: float = 1e-6
    """Relative difference below which two values count as copied."""
    change: float = 0.2
    """Relative difference to the computed value that is worth a note: a CAD model without cables,
    grease and paint differs by less."""


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


def has_plausible_size(solid: LinkSolid) -> bool:
    """Whether the size is plausible, so that length unit and scale are right."""
    return not len(solid.corners) or float(np.ptp(solid.corners, axis=0).max()) <= PLAUSIBLE_SIZE[1]


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
    findings += [
        make_link_finding(
            "doubtful_mesh", "warning", link, f"{solid.kind} of {solid.name}: {doubt}"
        )
        for doubt in solid.doubts
        if has_plausible_size(solid)
    ]
    if not has_plausible_size(solid):
        size = float(np.ptp(solid.corners, axis=0).max())
        findings.append(
            make_link_finding(
                "mesh_scale",
                "error",
                link,
                f"the {solid.kind} of {solid.name} is {size:.3g} m long",
                Cure('write scale="0.001 0.001 0.001" for a mesh in millimetres'),
            )
        )
    return findings


def check_described_mass(link: LinkMass, limits: Plausibility) -> list[Finding]:
    """Return what is implausible about the values of the description."""
    if link.described is None:
        return [
            make_link_finding(
                "no_inertia", "warning", link.name, "the description gives no inertia"
            )
        ]
    body, reason = link.described, link.described.inconsistency()
    computed = float("nan") if link.computed is None else link.computed.mass
    moments = np.diag(body.inertia_about_com)
    # All of these are NaN, and their comparisons false, where there is no geometry.
    half = (link.upper - link.lower) / 2.0
    largest = body.mass * (np.sum(half**2) - half**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        axis = int(np.argmax(moments / largest))
    outside = np.maximum(link.lower - body.com, body.com - link.upper).max()
    possible = (
        (
            reason is not None,
            make_link_finding("inconsistent_inertia", "error", link.name, reason or ""),
        ),
        (
            np.isfinite(link.density) and not limits.lightest <= link.density <= limits.heaviest,
            make_link_finding(
                "implausible_density",
                "error",
                link.name,
                f"{body.mass:.4g} kg in {1e3 * link.volume:.4g} litres is {link.density:.3g}"
                f" kg/m^3, outside {limits.lightest:g} to {limits.heaviest:g}",
            ),
        ),
        (
            body.mass > 0.0 and np.allclose(body.principal_moments, 1.0, rtol=limits.equal),
            make_link_finding(
                "unit_inertia", "error", link.name, "its inertia is 1 kg m^2 about every axis"
            ),
        ),
        (
            abs(link.mass_change) > limits.change,
            make_link_finding(
                "mass_differs",
                "info",
                link.name,
                f"{body.mass:.4g} kg in the description, {computed:.4g} kg computed",
            ),
        ),
        (
            np.any(moments > (1.0 + limits.equal) * largest),
            make_link_finding(
                "inertia_too_large",
                "error",
                link.name,
                f"I{'xyz'[axis] * 2} about the centre of mass is {moments[axis]:.3g} kg m^2; within"
                f" its box {body.mass:.4g} kg have at most {largest[axis]:.3g}",
            ),
        ),
        (
            body.mass > 0.0 and outside > limits.equal * half.max(),
            make_link_finding(
                "com_outside",
                "warning",
                link.name,
                f"its centre of mass lies {1e3 * outside:.3g} mm outside the box of its geometry",
            ),
        ),
    )
    return [finding for holds, finding in possible if holds]


def report_copies(links: list[LinkMass], limits: Plausibility) -> list[Finding]:
    """Return a finding per link whose inertia about the centre of mass equals another link's."""
    known = [(each.name, each.described) for each in links if each.described is not None]
    tensors = [(name, body.mass, body.inertia_about_com) for name, body in known if body.mass > 0.0]
    findings = []
    for k, (name, mass, tensor) in enumerate(tensors):
        same = [
            other
            for j, (other, its, of_other) in enumerate(tensors)
            if j != k
            and np.isclose(mass, its, rtol=limits.equal, atol=0.0)
            and np.abs(tensor - of_other).max() <= limits.equal * np.abs(tensor).max()
        ]
        if same:
            message = f"same mass and inertia as {', '.join(same)}"
            findings.append(make_link_finding("copied_inertia", "warning", name, message))
    return findings


def make_link_finding(
    code: str,
    severity: Literal["error", "warning", "info"],
    link: str,
    message: str,
    cure: Cure | None = None,
) -> Finding:
    """Return a finding whose message begins with the link."""
    return Finding(code, severity, f"link {link}: {message}", cure, link=link)


def sort_by_plausibility(links: list[LinkMass], findings: list[Finding]) -> tuple[LinkMass, ...]:
    """Sort links by their worst finding, then by the change of mass, both descending."""
    worst = {each.name: 3 for each in links}
    for finding in findings:
        if finding.link is not None:
            severity = SEVERITIES.index(finding.severity)
            worst[finding.link] = min(worst[finding.link], severity)
    return tuple(
        sorted(links, key=lambda each: (worst[each.name], -np.nan_to_num(abs(each.mass_change))))
    )
