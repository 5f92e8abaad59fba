"""Surfaces of meshes, which a process of its own reads with limits of what they may cost.

Mesh files are of unknown origin like logs: a few bytes may declare a billion triangles, or unpack
to them. One process reads all meshes of a command, so that small ones cost no start each, and this
one need not load a library of meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.errors import DescriptionError, MissingExtraError
from asbuilt.findings import Cure
from asbuilt.isolated_reading import Answer, FileKind, read_apart
from asbuilt.untrusted import TABLE_LIMIT

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".3mf")
MESH = FileKind(
    extra="cad",
    cure="export it again, as STL",
    what="mesh",
    error=DescriptionError,
    largest=TABLE_LIMIT,  # 4 million triangles as STL; a link of a robot has some 10 000
)
SMALLEST = 1e-9
LARGEST = 1e6
"""Sizes of a part [m], between which inertia has no overflow and is not zero."""


@dataclass(frozen=True, eq=False)
class MeshMeasures:
    """Hold what bounds a solid: its inertia for 1 kg/m^3, its box (2, 3) [m], whether it is closed.

    `inside_out` says that its triangles face inwards, which `inertia` allows for.
    """

    inertia: LinkInertia
    box: Array
    closed: bool
    inside_out: bool


def measure_mesh(path: str | Path, scale: Sequence[float] = (1.0, 1.0, 1.0)) -> MeshMeasures:
    """Measure the solid that a mesh bounds, `scale` metres per unit along each axis.

    Needs the extra `cad` (trimesh). Volume, centre and moments are integrals over the surface,
    exact for the given facets (Mirtich, 1996).

    Raises
    ------
    DescriptionError
        For files that hold no surface, or one without volume, and for those beyond the limits.
    MissingExtraError
        If trimesh is not installed.
    """
    suffix = Path(path).suffix
    if suffix.lower() not in MESH_SUFFIXES:
        raise DescriptionError(
            f"{path}: meshes are read from {', '.join(MESH_SUFFIXES)}, not from"
            f" {suffix or 'a file without suffix'!r}"
        )
    found, (box, centre, moments) = _read_apart(measure_solid, path, scale=[*map(float, scale)])
    volume = found["volume"]
    return MeshMeasures(
        LinkInertia.from_com(abs(volume), centre, moments.reshape(3, 3)),
        box.reshape(2, 3),
        found["closed"],
        volume < 0.0,
    )


def read_mesh_vertices(path: str | Path) -> Array:
    """Return the vertices (N, 3) of a mesh, in units of its file; errors as of `measure_mesh`."""
    _, (vertices,) = _read_apart(list_vertices, path)
    return vertices.reshape(-1, 3)


def _read_apart(read: Any, path: str | Path, **settings: Any) -> Answer:
    if find_spec("trimesh") is None:
        raise MissingExtraError("trimesh", "cad", "reading meshes")
    return read_apart(read, Path(path), MESH, **settings)


def list_vertices(path: Path) -> Answer:
    """Return the vertices of a mesh, in the process that reads it."""
    return {}, [np.asarray(_load_mesh(path).vertices, dtype=np.float64).ravel()]


def measure_solid(path: Path, scale: Sequence[float]) -> Answer:
    """Return volume, box, centre and moments of a mesh, in the process that reads it."""
    mesh = _load_mesh(path)
    mesh.merge_vertices()
    mesh.apply_transform(np.diag([*scale, 1.0]))
    size = float(np.max(mesh.extents))
    if not SMALLEST < size < LARGEST:
        raise DescriptionError(
            f"{path}: the part is {size:.3g} m long",
            cure=Cure("check the unit and the scale"),
            file=str(path),
        )
    volume = float(mesh.volume)
    if volume < 0.0:
        mesh.invert()
    if not abs(volume) > 0.0:
        raise DescriptionError(
            f"{path}: the mesh encloses no volume",
            cure=Cure("export the solid as a closed surface"),
            file=str(path),
        )
    mesh.density = 1.0
    shape = (np.asarray(mesh.bounds), np.asarray(mesh.center_mass), np.asarray(mesh.moment_inertia))
    closed = bool(mesh.is_watertight)
    return {"volume": volume, "closed": closed}, [each.ravel() for each in shape]


def _load_mesh(path: Path) -> Any:
    """Return the triangles of a file as trimesh has them."""
    import trimesh  # noqa: PLC0415 - an extra

    mesh: Any = trimesh.load(path, force="mesh", skip_materials=True)
    if len(mesh.faces) == 0 or not np.all(np.isfinite(mesh.vertices)):
        raise DescriptionError(f"{path}: the file holds no finite triangles", file=str(path))
    return mesh
