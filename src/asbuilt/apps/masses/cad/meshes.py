"""Mass properties of links from the shapes of their parts: mesh files and materials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import Link, LinkInertia, RobotModel, close_match, measure_mesh
from asbuilt.errors import DescriptionError
from asbuilt.ranges import Range

LENGTH = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "in": 0.0254,
    "inch": 0.0254,
    "ft": 0.3048,
}
MATERIALS: Mapping[str, float] = {
    "abs": 1050.0,
    "aluminium": 2700.0,
    "brass": 8500.0,
    "carbon-fibre": 1600.0,
    "cast-iron": 7200.0,
    "copper": 8960.0,
    "magnesium": 1770.0,
    "nylon": 1140.0,
    "pla": 1240.0,
    "pom": 1410.0,
    "stainless-steel": 7900.0,
    "steel": 7850.0,
    "titanium": 4430.0,
}
"""Usual densities [kg/m^3]; the density of a named alloy is better given as a number."""
DENSITIES = Range(0.0, 1e5, "kg/m^3", above=True)
"""Densities, from foams to four times the density of osmium."""

PLAUSIBLE_SIZE = (1e-3, 10.0)
"""Length of a part [m] below and above which its unit is doubtful."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPart:
    """One body of a link: a closed surface in a file, its material, and where it sits.

    `material` is a name of `MATERIALS` or a density [kg/m^3]; `unit` is the length unit of the
    file, which STL and OBJ do not state; `placement` (4, 4) is the pose of the file's axes in the
    frame of the link [m] (default: the same axes).
    """

    path: str | Path
    material: str | float
    unit: str
    placement: Array | None = None
    name: str = ""

    @property
    def density(self) -> float:
        """Density [kg/m^3]; raises `DescriptionError` as `look_up_density` does."""
        return look_up_density(self.material, str(self.path))


def look_up_density(material: str | float, place: str) -> float:
    """Return the density [kg/m^3] of a material of `MATERIALS`, or the number itself.

    Raises `DescriptionError` for an unknown material and a density that no matter has.

    >>> look_up_density("aluminium", "link_1")
    2700.0
    """
    if isinstance(material, str):
        if material not in MATERIALS:
            known = ", ".join(MATERIALS)
            raise DescriptionError(
                f"{place}: the material {material!r} is unknown; give a density in kg/m^3 or one of"
                f" {known}"
            )
        return MATERIALS[material]
    if not DENSITIES.holds(material):
        raise DescriptionError(
            f"{place}: the density is {material} kg/m^3; it must be a number {DENSITIES}"
        )
    return float(material)


@dataclass(frozen=True)
class CadLink:
    """A link with the mass properties that CAD gives it, and what is doubtful about them."""

    link: Link
    warnings: tuple[str, ...] = ()


def link_from_meshes(name: str, parts: Sequence[MeshPart]) -> CadLink:
    """Return a link with the mass properties of uniform solids bounded by meshes.

    Needs the extra `cad` (trimesh).

    Volume, centre and moments are integrals over the surface, exact for the given facets (Mirtich,
    1996). Warns where a surface is not closed, so that its volume means little, or is turned inside
    out (then it is turned back). Raises `DescriptionError` for files that hold no surface and for
    parts without volume.
    """
    if not parts:
        raise DescriptionError(f"link {name!r}: no parts are given; a link needs at least one mesh")
    bodies: list[tuple[str, LinkInertia]] = []
    warnings: list[str] = []
    for part in parts:
        inertia, doubts = mesh_inertia(part)
        bodies.append((part.name or Path(part.path).stem, inertia))
        warnings.extend(f"link {name!r}, {doubt}" for doubt in doubts)
    total = LinkInertia(np.sum([inertia.parameters for _, inertia in bodies], axis=0))
    return CadLink(Link(name=name, inertia=total, parts=tuple(bodies)), tuple(warnings))


def mesh_inertia(part: MeshPart) -> tuple[LinkInertia, tuple[str, ...]]:
    """Return the inertia of one part in the frame of its link, and warnings about its surface.

    Raises `DescriptionError` as `link_from_meshes` does.
    """
    if part.unit not in LENGTH:
        raise DescriptionError(
            f"{part.path}: the length unit {part.unit!r} is unknown; known are {', '.join(LENGTH)}"
        )
    density = part.density
    solid = read_mesh(part.path, scale=(LENGTH[part.unit],) * 3)
    inertia = LinkInertia(density * solid.inertia.parameters)
    return (inertia if part.placement is None else inertia.moved(part.placement)), solid.doubts


@dataclass(frozen=True, eq=False)
class MeshSolid:
    """Hold a solid bounded by a mesh: inertia for unit density, corners of its box, doubts.

    `inertia` is for 1 kg/m^3, so that its mass is the volume [m^3]; `corners` (8, 3) are corners
    of the box around it, along the axes of the file [m].
    """

    inertia: LinkInertia
    corners: Array
    doubts: tuple[str, ...] = ()
    closed: bool = True


def read_mesh(path: str | Path, scale: Sequence[float] = (1.0, 1.0, 1.0)) -> MeshSolid:
    """Read the solid bounded by the mesh of a file, `scale` metres per unit along each axis.

    Raises `DescriptionError` and `MissingExtraError` as `measure_mesh` does.
    """
    path = Path(path)
    measured = measure_mesh(path, scale)
    doubts = []
    if not measured.closed:
        doubts.append(
            f"{path.name}: the surface is not closed, so volume and mass are not reliable; repair"
            " the mesh"
        )
    if measured.inside_out:
        doubts.append(f"{path.name}: the surface was turned inside out and is turned back")
    size = float(np.max(np.ptp(measured.box, axis=0)))
    if size > PLAUSIBLE_SIZE[1] or size < PLAUSIBLE_SIZE[0]:
        doubts.append(f"{path.name}: the part is {size:.3g} m long; check the unit and the scale")
    corners = np.array(np.meshgrid(*measured.box.T)).reshape(3, -1).T
    return MeshSolid(measured.inertia, corners, tuple(doubts), measured.closed)


def with_cad_links(model: RobotModel, links: Mapping[str, CadLink]) -> RobotModel:
    """Return the robot with the mass properties of the named links replaced.

    The warnings are added to the notes of the model.

    Raises `DescriptionError` for a name that is no link of the robot.
    """
    for name in links:
        if name not in model.link_names:
            raise DescriptionError(
                f"{model.name} has no link {name!r}{close_match(name, model.link_names)}; its links"
                f" are {', '.join(model.link_names)}"
            )
    replaced = tuple(
        replace(links[link.name].link, name=link.name) if link.name in links else link
        for link in model.links
    )
    warnings = tuple(warning for cad in links.values() for warning in cad.warnings)
    return replace(model, links=replaced, notes=(*model.notes, *warnings))
