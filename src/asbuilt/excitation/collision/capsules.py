"""Bodies that must not touch: capsules on the links, and obstacles."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, PositiveFloat, ValidationError

from asbuilt.arrays import Array, read_only
from asbuilt.description.appearance import link_solids
from asbuilt.description.formats.xml import (
    described_text,
    parse_xml,
    read_extents,
    read_numbers,
    read_origin,
)
from asbuilt.description.meshes import read_mesh_vertices
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.description.rotation import placement, rotation_from_rpy
from asbuilt.errors import DescriptionError
from asbuilt.untrusted import describe_problem, parse_toml, read_text

CLEARANCE = 0.02
"""Default distance between bodies [m]."""

FLOOR_SIZE = 20.0
FLOOR_DEPTH = 1.0
"""Sides and thickness of the box that represents a floor [m]."""


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` of the segment from `start` to `stop` (3,) [m].

    The segment is in the axes of a link, or of the world (`ROOT`).
    """

    link: int
    start: Array
    stop: Array
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", read_only(self.start))
        object.__setattr__(self, "stop", read_only(self.stop))

    @classmethod
    def around(cls, link: int, points: ArrayLike) -> Capsule:
        """Return a small capsule around points (N, 3), along their longest extent.

        The least of three along principal axes.
        """
        cloud = np.asarray(points, dtype=np.float64)
        middle = (cloud.max(axis=0) + cloud.min(axis=0)) / 2
        _, _, axes = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)
        found = []
        for axis in (*axes, *np.eye(3)):
            centred = cloud - middle
            across = centred - np.outer(centred @ axis, axis)
            centred -= (across.max(axis=0) + across.min(axis=0)) / 2
            along = centred @ axis
            off = np.linalg.norm(centred - np.outer(along, axis), axis=1)
            radius = float(off.max())
            rounded = np.sqrt(np.maximum(radius**2 - off**2, 0.0))
            low = float((along + rounded).min())
            high = float((along - rounded).max())
            if low > high:
                low = high = (low + high) / 2
            base = cloud[0] - centred[0]
            volume = math.pi * radius**2 * (high - low + 4 / 3 * radius)
            found.append((volume, base + low * axis, base + high * axis, radius))
        _, start, stop, radius = min(found, key=lambda item: item[0])
        return cls(link, start, stop, radius)


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A box of `size` (3,) at a pose (4, 4) in the root frame [m]."""

    name: str
    size: Array
    pose: Array


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Capsules on links, obstacles, pairs of links that may touch, and the clearance [m]."""

    capsules: tuple[Capsule, ...]
    obstacles: tuple[Obstacle, ...] = ()
    allowed: frozenset[frozenset[int]] = frozenset()
    clearance: float = CLEARANCE


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _CapsuleTable(_Table):
    link: str
    start: tuple[float, float, float]
    stop: tuple[float, float, float]
    radius: float


class _ObstacleTable(_Table):
    name: str = "obstacle"
    size: tuple[PositiveFloat, PositiveFloat, PositiveFloat]
    position: tuple[float, float, float]
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)


class _SurroundingsFile(_Table):
    clearance: NonNegativeFloat = CLEARANCE
    floor: float | None = None
    skeleton: float | None = None
    capsules: list[_CapsuleTable] = []
    obstacles: list[_ObstacleTable] = []
    allowed: list[tuple[str, str]] = []


def build_surroundings(model: RobotModel, source: str | Path) -> Surroundings:
    """Return the bodies that a design must keep apart.

    `skeleton` or `skeleton:RADIUS`, the geometry of a URDF file, or a TOML file.

    The TOML has `clearance`, `floor` (height of a floor), `skeleton` (radius), `[[capsules]]` with
    link, start, stop, radius, `[[obstacles]]` (boxes) with size, position, rpy, and `allowed`,
    pairs of links that may touch. Raises `DescriptionError` if it is invalid.
    """
    text = str(source)
    if text == "skeleton" or text.startswith("skeleton:"):
        try:
            radius = float(text.partition(":")[2]) if ":" in text else None
        except ValueError:
            raise DescriptionError(
                f"skeleton:RADIUS takes a radius in metres, got {text!r}"
            ) from None
        return Surroundings(build_skeleton_capsules(model, radius))
    path = Path(text)
    if path.suffix.lower() in (".urdf", ".xml"):
        return Surroundings(read_urdf_capsules(model, path))
    try:
        content = parse_toml(read_text(path, "collision file", DescriptionError))
        file = _SurroundingsFile.model_validate(content)
    except ValidationError as problem:
        first = problem.errors()[0]
        raise DescriptionError(
            f"{path}: {'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
        ) from None
    except (ValueError, DescriptionError) as problem:
        raise DescriptionError(
            f"{path} cannot be read: {describe_problem(problem)}; give skeleton, skeleton:RADIUS,"
            " a .urdf or"
            " a .toml file"
        ) from None
    return _build_from_file(model, file, path)


def _build_from_file(model: RobotModel, file: _SurroundingsFile, path: Path) -> Surroundings:
    capsules = (
        list(build_skeleton_capsules(model, file.skeleton)) if file.skeleton is not None else []
    )
    for table in file.capsules:
        link, pose = _find_carrier(model, table.link, path)
        ends = [pose[:3, :3] @ np.array(end) + pose[:3, 3] for end in (table.start, table.stop)]
        if not table.radius > 0:
            raise DescriptionError(
                f"{path}: the radius of the capsule on {table.link} must be positive, got"
                f" {table.radius}"
            )
        capsules.append(Capsule(link, ends[0], ends[1], table.radius))
    if not capsules:
        raise DescriptionError(
            f"{path}: no [[capsules]] and no skeleton, so nothing can collide; give skeleton ="
            " RADIUS or capsules"
        )
    obstacles = [
        Obstacle(
            table.name,
            np.array(table.size),
            placement(rotation_from_rpy(list(table.rpy)), list(table.position)),
        )
        for table in file.obstacles
    ]
    if file.floor is not None:
        size = np.array([FLOOR_SIZE, FLOOR_SIZE, FLOOR_DEPTH])
        obstacles.append(
            Obstacle("floor", size, placement(np.eye(3), [0.0, 0.0, file.floor - FLOOR_DEPTH / 2]))
        )
    allowed = frozenset(
        frozenset(_find_carrier(model, name, path)[0] for name in pair) for pair in file.allowed
    )
    return Surroundings(tuple(capsules), tuple(obstacles), allowed, file.clearance)


def build_skeleton_capsules(model: RobotModel, radius: float | None = None) -> tuple[Capsule, ...]:
    """Return a capsule along each rod of the robot's stick figure.

    With a `radius` [m], all are that thick.
    """
    if radius is not None and not radius > 0:
        raise DescriptionError(f"the radius of a skeleton must be positive, got {radius}")
    return tuple(
        Capsule(solid.link, solid.start, solid.stop, solid.radius if radius is None else radius)
        for solid in link_solids(model)
        if solid.kind == "rod"
    )


def read_urdf_capsules(model: RobotModel, path: str | Path) -> tuple[Capsule, ...]:
    """Return a capsule around each `<collision>` geometry of a URDF file.

    Boxes, cylinders, spheres, and meshes that can be found.

    Raises DescriptionError where there is none; MissingExtraError where a mesh needs trimesh.
    """
    content, source = described_text(path)
    found: list[Capsule] = []
    missing: list[str] = []
    for element in parse_xml(content, source).findall("link"):
        link, pose = _find_carrier(model, element.get("name", ""), Path(source))
        for collision in element.findall("collision"):
            geometry = collision.find("geometry")
            if geometry is None or not len(geometry):
                continue
            place = f"{source}, link {element.get('name')!r}, collision"
            xyz, rpy = read_origin(collision.find("origin"), place)
            points = _find_points(geometry[0], place, Path(source).parent)
            if points is None:
                missing.append(geometry[0].get("filename", f"<{geometry[0].tag}>"))
            else:
                whole = pose @ placement(rotation_from_rpy(rpy), xyz)
                found.append(Capsule.around(link, points @ whole[:3, :3].T + whole[:3, 3]))
    if not found:
        reason = (
            f"its {len(missing)} meshes, such as {missing[0]}, are not next to it"
            if missing
            else "it has none"
        )
        raise DescriptionError(
            f"{source}: no <collision> geometry can be read, {reason}; give skeleton:RADIUS or a"
            " TOML file with capsules"
        )
    return tuple(found)


def _find_points(shape: Any, place: str, folder: Path) -> Array | None:
    """Return points whose capsule holds the shape, in its own frame."""
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    if shape.tag == "box":
        half = np.array(read_extents(shape, "size", 3, place)) / 2
        return np.array(np.meshgrid(*[(-h, h) for h in half])).reshape(3, -1).T
    if shape.tag == "cylinder":
        (radius,) = read_extents(shape, "radius", 1, place)
        (length,) = read_extents(shape, "length", 1, place)
        ring = radius * np.column_stack([np.cos(around), np.sin(around)])
        return np.vstack(
            [np.column_stack([ring, np.full(24, z)]) for z in (-length / 2, length / 2)]
        )
    if shape.tag == "sphere":
        return read_extents(shape, "radius", 1, place)[0] * np.vstack([np.eye(3), -np.eye(3)])
    if shape.tag != "mesh":
        return None
    name = shape.get("filename", "")
    relative = name.partition("://")[2].partition("/")[2] if "://" in name else name
    candidates = [parent / relative for parent in (folder, *Path(os.path.realpath(folder)).parents)]
    file = next((candidate for candidate in candidates if candidate.is_file()), None)
    if file is None:
        return None
    try:
        vertices = read_mesh_vertices(file)
    except DescriptionError as problem:
        raise DescriptionError(
            f"{place}: {problem.message}; give skeleton:RADIUS or a TOML file with capsules"
        ) from None
    scale = np.array(read_numbers(shape, "scale", 3, place)) if shape.get("scale") else np.ones(3)
    return vertices * scale


def _find_carrier(model: RobotModel, name: str, path: Path) -> tuple[int, Array]:
    """Return the moving link (or `ROOT`) that carries a link or frame, and its pose in it."""
    places = model.places
    if name not in places and name not in ("world", "root"):
        raise DescriptionError(
            f"{path}: {model.name} has no link {name!r}; it has {', '.join(model.link_names)}"
        )
    return places.get(name, (ROOT, np.eye(4)))


def list_neighbours(model: RobotModel) -> frozenset[frozenset[int]]:
    """Return the pairs of links joined by a joint."""
    return frozenset(frozenset((i, parent)) for i, parent in enumerate(model.parents))
