"""Solids of the links of a URDF: primitives and meshes of its visual or collision geometry."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from asbuilt.apps.masses.cad.meshes import MeshSolid, read_mesh
from asbuilt.arrays import Array
from asbuilt.description import (
    ROOT,
    LinkInertia,
    RobotModel,
    described_text,
    parse_xml,
    placement,
    read_extents,
    read_numbers,
    read_origin,
    rotation_from_rpy,
)
from asbuilt.errors import DescriptionError

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
            best = min(usable, key=lambda each: (bool(each.missing), not each.closed))
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
            missing.append(geometry[0].get("filename", geometry[0].tag))
            doubts.append(str(error))
            continue
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
        (r,), (h,) = (
            read_extents(shape, "radius", 1, place),
            read_extents(shape, "length", 1, place),
        )
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
