"""Meshes of rods and housings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.appearance import Solid
from asbuilt.description.rotation import rotation_onto


def round_mesh(
    solid: Solid, slices: int = 28, rings: int = 7, segments: int = 1
) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (v, 3) and outward triangles (f, 3) of a rod or a housing.

    `rings` are those of a rod's round end, `segments` the parts of its length.
    """
    length, radius = solid.length, solid.radius
    if solid.kind == "rod":
        angles = np.linspace(0.0, np.pi / 2, rings)
        along = np.linspace(0.0, length, segments + 1)[1:-1]
        profile = [(radius * np.sin(a), -radius * np.cos(a)) for a in angles]
        profile += [(radius, z) for z in along]
        profile += [(radius * np.cos(a), length + radius * np.sin(a)) for a in angles]
    else:
        bevel = min(0.12 * radius, 0.3 * length)
        ends = (0.0, *np.linspace(0.0, 1.0, segments)[1:-1], 1.0)
        low = [(share * (radius - bevel), 0.0) for share in ends]
        high = [(share * (radius - bevel), length) for share in ends[::-1]]
        wall = [(radius, z) for z in np.linspace(bevel, length - bevel, segments + 1)]
        profile = [*low, *wall, *high]
    turn = np.linspace(0.0, 2 * np.pi, slices, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(slices)], axis=1)
    vertices = np.concatenate([r * circle + [0.0, 0.0, z] for r, z in profile])
    k, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(slices), indexing="ij")
    a, b = (k * slices + j).ravel(), (k * slices + (j + 1) % slices).ravel()
    faces = np.concatenate(
        [np.stack([a, b, b + slices], axis=1), np.stack([a, b + slices, a + slices], axis=1)]
    )
    return vertices @ rotation_onto((solid.stop - solid.start) / length).T + solid.start, faces
