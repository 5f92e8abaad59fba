"""Mass properties of links from geometry and material, or a table, compared with the file's."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from asbuilt.apps.masses.cad.meshes import look_up_density
from asbuilt.apps.masses.cad.solids import GeometryKind, LinkSolid, read_solids
from asbuilt.apps.masses.cad.table import read_cad_table
from asbuilt.apps.masses.mass_findings import (
    LinkMass,
    check_described_mass,
    check_surface,
    has_plausible_size,
    sort_by_plausibility,
)
from asbuilt.arrays import Array
from asbuilt.description import (
    Link,
    LinkInertia,
    Plausibility,
    RobotModel,
    add_plausibility,
    close_match,
    make_link_finding,
)
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Finding

Material = str | float
"""Name of a material, or a density [kg/m^3]."""


@dataclass(frozen=True, eq=False)
class LinkMasses:
    """Hold the mass properties of all links, the least plausible first, and findings on them."""

    model: RobotModel
    links: tuple[LinkMass, ...]
    findings: tuple[Finding, ...]

    @property
    def computed_model(self) -> RobotModel:
        """The robot with the computed mass properties, where there are any."""
        computed = {link.name: link.computed for link in self.links if link.computed is not None}
        links = (
            Link(name=link.name, inertia=computed[link.name]) if link.name in computed else link
            for link in self.model.links
        )
        return replace(self.model, links=tuple(links))

    def __repr__(self) -> str:
        known = sum(link.computed is not None for link in self.links)
        return (
            f"LinkMasses({self.model.name!r}, {known} of {len(self.links)} links computed,"
            f" {len(self.findings)} findings)"
        )


def link_masses(
    model: RobotModel,
    *,
    meshes: str | os.PathLike[str] | None = None,
    density: float | Mapping[str, float] | None = None,
    material: str | Mapping[str, str] | None = None,
    table: str | os.PathLike[str] | None = None,
    about: Literal["com", "origin"] | None = None,
    products: Literal["tensor", "integral"] | None = None,
    prefer: GeometryKind = "visual",
    thresholds: Plausibility | None = None,
) -> LinkMasses:
    """Compute the mass properties of links and compare them with the description's.

    Without `density`, `material` and `table`, each link keeps its mass, spread evenly over its
    geometry.

    Parameters
    ----------
    model
        The robot; geometry comes from the URDF file it was read from.
    meshes
        Folder with the meshes; by default they are searched for in the URDF's folder and above.
    density, material
        Density [kg/m^3] or material of all links, or of each by name.
    table
        Table of a CAD program, as `read_cad_table` reads it, in place of geometry.
    about, products
        Conventions of the table: tensor about the centre of mass ("com") or the "origin", products
        as entries of the "tensor" or as the plain "integral" of x y dm.
    prefer
        Geometry that counts where a link has both.
    thresholds
        Limits of what is plausible.

    Returns
    -------
    LinkMasses
        Links, the least plausible first, with findings.

    Raises
    ------
    DescriptionError
        If the robot has no geometry, the folder or a mesh is not there, a material is unknown or
        the table cannot be read.
    UsageError
        If the arguments exclude each other.

    Examples
    --------
    >>> from asbuilt.description.load import load_robot
    >>> link_masses(load_robot("two-link"), density=2700.0)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    asbuilt.errors.DescriptionError: two-link does not come from a URDF file, so it has no ...
    """
    limits = thresholds or Plausibility()
    if table is not None:
        if density is not None or material is not None or meshes is not None:
            raise UsageError("a table has masses already; leave meshes, density and material out")
        if about is None or products is None:
            raise UsageError(
                "a table does not state its conventions; give about ('com' or 'origin') and"
                " products ('tensor' or 'integral')"
            )
        links, findings = _read_table(model, Path(table), about, products)
    else:
        folder = None if meshes is None else Path(meshes)
        if folder is not None and not folder.is_dir():
            raise DescriptionError(f"there is no folder {folder} with meshes", file=str(folder))
        solids = read_solids(model, [] if folder is None else [folder], prefer=prefer)
        links, findings = _weigh_solids(model, solids, _read_materials(model, density, material))
    findings += [found for link in links for found in check_described_mass(link, limits)]
    findings = list(add_plausibility(model, findings))
    return LinkMasses(model, sort_by_plausibility(links, findings), tuple(findings))


def _read_materials(
    model: RobotModel,
    density: float | Mapping[str, float] | None,
    material: str | Mapping[str, str] | None,
) -> dict[str, float] | None:
    """Return densities by link, "" for all others; None if masses of the description count."""
    if density is None and material is None:
        return None
    if density is not None and material is not None and not isinstance(density, Mapping):
        raise UsageError("density and material exclude each other unless each names its links")
    names = (*model.link_names, *(frame.name for frame in model.frames))
    found: dict[str, float] = {}
    for given in (material, density):
        by_link = given if isinstance(given, Mapping) else {} if given is None else {"": given}
        for name, value in by_link.items():
            if name and name not in names:
                raise DescriptionError(
                    f"{model.name} has no link {name!r}{close_match(name, names)}; its links are"
                    f" {', '.join(names)}"
                )
            found[name] = look_up_density(value, f"link {name!r}" if name else model.name)
    return found


def _weigh_solids(
    model: RobotModel, solids: tuple[LinkSolid, ...], densities: Mapping[str, float] | None
) -> tuple[list[LinkMass], list[Finding]]:
    links = list[LinkMass]()
    findings = list[Finding]()
    for k, link in enumerate(model.links):
        own = [solid for solid in solids if solid.link == k]
        findings += [found for solid in own for found in check_surface(link.name, solid)]
        if not own:
            findings.append(
                make_link_finding("no_geometry", "info", link.name, "it has no geometry")
            )
        parts = dict(link.parts) or {link.name: link.inertia}
        scaled = list[Array]()
        complete = bool(own)
        for solid in own:
            value = _find_density(solid, link.name, densities, parts)
            complete = (
                complete and value is not None and not solid.missing and has_plausible_size(solid)
            )
            scaled += [] if value is None else [value * solid.inertia.parameters]
        sized = [solid for solid in own if has_plausible_size(solid)]
        known = [solid.corners for solid in sized if len(solid.corners)]
        corners = np.concatenate(known or [np.full((1, 3), np.nan)])
        links.append(
            LinkMass(
                link.name,
                link.inertia if link.inertia_known else None,
                LinkInertia(np.sum(scaled, axis=0)) if complete and scaled else None,
                own[0].kind if own else "",
                sum(solid.inertia.mass for solid in sized) or float("nan"),
                corners.min(axis=0),
                corners.max(axis=0),
            )
        )
    return links, findings


def _find_density(
    solid: LinkSolid,
    carrier: str,
    densities: Mapping[str, float] | None,
    parts: Mapping[str, LinkInertia],
) -> float | None:
    if densities is not None:
        names = [name for name in (solid.name, carrier, "") if name in densities]
        return densities[names[0]] if names else None
    mass = parts[solid.name].mass if solid.name in parts else 0.0
    return mass / solid.inertia.mass if mass > 0.0 and solid.inertia.mass > 0.0 else None


def _read_table(
    model: RobotModel,
    path: Path,
    about: Literal["com", "origin"],
    products: Literal["tensor", "integral"],
) -> tuple[list[LinkMass], list[Finding]]:
    read = read_cad_table(path, about=about, products=products)
    for name in read:
        if name not in model.link_names:
            raise DescriptionError(
                f"{path}: {model.name} has no link {name!r}{close_match(name, model.link_names)};"
                f" its links are {', '.join(model.link_names)}"
            )
    unknown = np.full(3, np.nan)
    links = [
        LinkMass(
            link.name,
            link.inertia if link.inertia_known else None,
            read[link.name].link.inertia if link.name in read else None,
            "table" if link.name in read else "",
            float("nan"),
            unknown,
            unknown,
        )
        for link in model.links
    ]
    return links, [
        make_link_finding("doubtful_table", "warning", name, doubt)
        for name, cad in read.items()
        for doubt in cad.warnings
    ]
