"""Solids of links: meshes with their mass properties, and primitives of a URDF."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import (
    ROOT,
    Link,
    LinkInertia,
    RobotModel,
    close_match,
    described_text,
    measure_mesh,
    parse_xml,
    placement,
    read_extents,
    read_numbers,
    read_origin,
    rotation_from_rpy,
)
from asbuilt.errors import DescriptionError
from asbuilt.ranges import Range

GeometryKind = Literal["visual", "collision"]


@dataclass(frozen=True, eq=False)
class LinkSolid:
    """Hold the geometry of one link of the file, in the frame of the moving link that carries it.

    `name` is the link of the file, `link` the index of the moving link. `inertia` is for unit
    density, its mass the volume [m^3]; `corners` (8 k, 3) belong to the boxes around its k
    bodies [m]. `missing` are meshes not found, `doubts` sentences on unreliable surfaces.
    """

    name: str
    link: int
    kind: GeometryKind
    inertia: LinkInertia
    corners: Array
    doubts: tuple[str, ...] = ()
    closed: bool = True
    missing: tuple[str, ...] = ()

    @property
    def size(self) -> float:
        """Longest side of the box around it [m], 0 without a body."""
        return float(np.ptp(self.corners, axis=0).max()) if len(self.corners) else 0.0

    @property
    def has_plausible_size(self) -> bool:
        """Whether no part of a robot is larger, so that length unit and scale are right."""
        return self.size <= PLAUSIBLE_SIZE[1]


def read_solids(
    model: RobotModel, folders: Sequence[Path] = (), *, prefer: GeometryKind = "visual"
) -> tuple[LinkSolid, ...]:
    """Read the solids of all links of the URDF that a robot came from.

    Of `<visual>` and `<collision>` the preferred one counts, unless its meshes are missing,
    unreadable or not closed and the other's are not. Meshes are searched in `folders`,
    then next to the file and in the folders above it. Bodies of one link add up.

    Raises
    ------
    DescriptionError
        If the robot does not come from a URDF file.
    """
    path = Path(model.source)
    content, source = described_text(path) if path.is_file() else (b"", model.source)
    root = parse_xml(content, source) if content else None
    if root is None or root.tag != "robot":
        raise DescriptionError(
            f"{model.name} does not come from a URDF file, so it has no geometry; give the mass"
            " properties as a table"
        )
    searched = [*folders, path.parent, *Path(os.path.realpath(path)).parent.parents]
    other: GeometryKind = "collision" if prefer == "visual" else "visual"
    found = []
    for element in root.findall("link"):
        name = (element.get("name") or "").strip()
        link, pose = model.places.get(name, (ROOT, np.eye(4)))
        if link == ROOT:
            continue
        solids = [
            _read_solid(element, name, link, pose, kind, searched, source)
            for kind in (prefer, other)
        ]
        usable = [solid for solid in solids if solid is not None]
        if usable:
            best = min(usable, key=lambda solid: (bool(solid.missing), not solid.closed))
            found.append(best if best is usable[0] else _replace_preferred(best, usable[0]))
    return tuple(found)


def _replace_preferred(taken: LinkSolid, left: LinkSolid) -> LinkSolid:
    """Return the solid taken, with what is wrong with the preferred one."""
    wrong = (*left.doubts, *(f"{name} was not found" for name in left.missing))[0]
    return replace(taken, doubts=(f"counts instead of {left.kind}: {wrong}", *taken.doubts))


def _read_solid(
    element: Element,
    name: str,
    link: int,
    pose: Array,
    kind: GeometryKind,
    folders: Sequence[Path],
    source: str,
) -> LinkSolid | None:
    """Return the sum of all bodies of a kind, or None if there are none."""
    bodies = list[MeshSolid]()
    missing = list[str]()
    doubts = list[str]()
    for body in element.findall(kind):
        geometry = body.find("geometry")
        if geometry is None or not len(geometry):
            continue
        place = f"{source}, link {name!r}, {kind}"
        try:
            solid = _read_body(geometry[0], place, folders)
        except DescriptionError as error:
            if geometry[0].tag != "mesh":
                raise  # a number that makes no sense, not a file to look for elsewhere
            doubts.append(str(error))
            solid = None
        if solid is None:
            missing.append(geometry[0].get("filename", geometry[0].tag))
            continue
        xyz, rpy = read_origin(body.find("origin"), place)
        whole = pose @ placement(rotation_from_rpy(rpy), xyz)
        corners = solid.corners @ whole[:3, :3].T + whole[:3, 3]
        bodies.append(MeshSolid(solid.inertia.moved(whole), corners, solid.doubts, solid.closed))
    if not bodies and not missing:
        return None
    total = np.sum([body.inertia.parameters for body in bodies], axis=0) if bodies else np.zeros(10)
    return LinkSolid(
        name,
        link,
        kind,
        LinkInertia(total),
        np.concatenate([body.corners for body in bodies]) if bodies else np.zeros((0, 3)),
        (*doubts, *(doubt for body in bodies for doubt in body.doubts)),
        all(body.closed for body in bodies),
        tuple(missing),
    )


def _read_body(shape: Element, place: str, folders: Sequence[Path]) -> MeshSolid | None:
    """Return a primitive, or the solid of a mesh; None if its file is not there."""
    if shape.tag == "box":
        x, y, z = read_extents(shape, "size", 3, place)
        return _make_primitive(
            x * y * z, (x, y, z), (y * y + z * z, x * x + z * z, x * x + y * y), 12
        )
    if shape.tag == "cylinder":
        (r,) = read_extents(shape, "radius", 1, place)
        (h,) = read_extents(shape, "length", 1, place)
        across = 3.0 * r * r + h * h
        sizes = (2.0 * r, 2.0 * r, h)
        return _make_primitive(np.pi * r * r * h, sizes, (across, across, 6.0 * r * r), 12)
    if shape.tag == "sphere":
        (r,) = read_extents(shape, "radius", 1, place)
        return _make_primitive(4.0 / 3.0 * np.pi * r**3, (2.0 * r,) * 3, (2.0 * r * r,) * 3, 5)
    if shape.tag != "mesh":
        return None
    file = find_mesh(shape.get("filename", ""), folders)
    if file is None:
        return None
    return read_mesh(
        file, read_numbers(shape, "scale", 3, place) if shape.get("scale") else [1.0] * 3
    )


def _make_primitive(
    volume: float, sizes: Sequence[float], squares: Sequence[float], divisor: float
) -> MeshSolid:
    """Return a centred solid whose moments are `volume squares / divisor` for unit density."""
    inertia = LinkInertia.from_com(volume, np.zeros(3), volume * np.diag(squares) / divisor)
    corners = np.array(np.meshgrid(*[(-size / 2, size / 2) for size in sizes])).reshape(3, -1).T
    return MeshSolid(inertia, corners)


def find_mesh(filename: str, folders: Sequence[Path]) -> Path | None:
    """Return the file of a mesh: its path, without leading folders if need be, in one of `folders`.

    `package://` and `file://` are left out, as in `package://ur/meshes/base.stl`.
    """
    relative = filename.partition("://")[2] if "://" in filename else filename
    parts = PurePosixPath(relative).parts
    tails = [Path(*parts[first:]) for first in range(len(parts))]
    candidates = [folder / tail for folder in folders for tail in tails]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


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
        inertia, doubts = _weigh_part(part)
        bodies.append((part.name or Path(part.path).stem, inertia))
        warnings.extend(f"link {name!r}, {doubt}" for doubt in doubts)
    total = LinkInertia(np.sum([inertia.parameters for _, inertia in bodies], axis=0))
    return CadLink(Link(name=name, inertia=total, parts=tuple(bodies)), tuple(warnings))


def _weigh_part(part: MeshPart) -> tuple[LinkInertia, tuple[str, ...]]:
    """Return the inertia of one part in the frame of its link, and warnings about its surface."""
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
