"""A robot drawn as shaded rods and housings without OpenGL, by the painter's algorithm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw

from asbuilt.arrays import Array, Image
from asbuilt.description import ROOT, Solid, rotation_onto
from asbuilt.writers.pictures.motion_view import MotionView, place_ends


def build_round_mesh(
    solid: Solid, slices: int = 28, rings: int = 7, segments: int = 1
) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (v, 3) and outward triangles (f, 3) of a rod or a housing.

    `rings` are the rings of a rod's round end, `segments` the parts of its length.
    """
    length = solid.length
    radius = solid.radius
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
    a = (k * slices + j).ravel()
    b = (k * slices + (j + 1) % slices).ravel()
    faces = np.concatenate(
        [np.stack([a, b, b + slices], axis=1), np.stack([a, b + slices, a + slices], axis=1)]
    )
    return vertices @ rotation_onto((solid.stop - solid.start) / length).T + solid.start, faces


ROD = (196, 201, 208)
HOUSING = (236, 128, 36)
STAND = (112, 118, 126)
SHADOW = (216, 220, 225)
GRID = (228, 231, 235)
PATH = (0, 114, 178)
AZIMUTH = np.deg2rad(-45.0)
ELEVATION = np.deg2rad(18.0)


OVERSAMPLING = 2
"""Pixels drawn for each one that is shown, for smooth edges."""
DISTANCE = 5.0
"""Distance of the camera in radii of the scene."""
AMBIENT = 0.55
DIFFUSE = 0.5
"""Light from everywhere, and from the lamp above the left shoulder of the camera."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Perspective camera whose picture holds a scene: axes (3, 3) right, up, forward; eye (3,)."""

    axes: Array
    eye: Array
    scale: float
    shift: Array

    @classmethod
    def around(cls, view: MotionView, width: int, height: int) -> Camera:
        """Return the camera that sees every pose and the path, with a margin around them."""
        seed = np.array([1.0, 0.0, 0.0]) if abs(view.up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        along = seed - (seed @ view.up) * view.up
        along /= np.linalg.norm(along)
        level = np.cos(AZIMUTH) * along + np.sin(AZIMUTH) * np.cross(view.up, along)
        forward = -(np.cos(ELEVATION) * level + np.sin(ELEVATION) * view.up)
        right = np.cross(forward, view.up) / np.cos(ELEVATION)
        axes = np.stack([right, np.cross(right, forward), forward])
        camera = cls(axes, view.centre - DISTANCE * view.radius * forward, 1.0, np.zeros(2))
        points, radii = _list_balls(view)
        flat, depth = camera.project(points)
        grown = (radii / depth)[:, None] * 1.05
        low = (flat - grown).min(axis=0)
        high = (flat + grown).max(axis=0)
        size = np.array([width, height])
        # 0.06: share of the picture that stays free at each side.
        scale = float(np.min((1 - 2 * 0.06) * size / (high - low)))
        return cls(axes, camera.eye, scale, size / 2 - scale * (low + high) / 2)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return pixels (N, 2), rows downward, and depths (N,) [m]."""
        right, up, depth = self.axes @ (points - self.eye).T
        return self.scale * np.stack([right, -up], axis=1) / depth[:, None] + self.shift, depth


def draw_skeleton_frames(view: MotionView, width: int, height: int) -> Iterator[Image]:
    """Yield every frame of a motion as an image (height, width, 3)."""
    size = OVERSAMPLING * width, OVERSAMPLING * height
    camera = Camera.around(view, *size)
    # Slices, rings and segments, fewer where many frames are drawn.
    parts = (16, 4, 4) if len(view.t) > 1 else (36, 8, 10)
    solids = [*view.solids, *view.stand]
    meshes = [build_round_mesh(solid, *parts) for solid in solids]
    colours = [
        STAND if k >= len(view.solids) else ROD if solid.kind == "rod" else HOUSING
        for k, solid in enumerate(solids)
    ]
    counts = [len(faces) for _, faces in meshes]
    shades = np.repeat(np.array(colours), counts, axis=0)
    # A housing counts as nearer than the rods that it encloses, by this part of its radius.
    nearer = np.repeat([0.4 * s.radius * (s.kind == "housing") for s in solids], counts)
    for k in range(len(view.t)):
        corners = np.concatenate(
            [
                _place_points(view, k, solid, points)[faces]
                for solid, (points, faces) in zip(solids, meshes, strict=True)
            ]
        )
        canvas = Pillow.new("RGB", size, "white")
        draw = ImageDraw.Draw(canvas)
        _draw_floor(draw, camera, view)
        _draw_shadows(draw, camera, view, corners)
        _draw_bodies(draw, camera, view, corners, shades, nearer)
        yield np.asarray(canvas.resize((width, height), Pillow.Resampling.BOX))


def _draw_bodies(
    draw: ImageDraw.ImageDraw,
    camera: Camera,
    view: MotionView,
    corners: Array,
    shades: Array,
    nearer: Array,
) -> None:
    """Draw the faces towards the camera and the path, the farthest first."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1)
    middles = corners.mean(axis=1)
    seen = (np.einsum("ij,ij->i", normals, middles - camera.eye) < 0) & (size > 0)
    seen &= middles @ view.up > view.floor
    normals = normals[seen] / size[seen, None]
    corners = corners[seen]
    right, up, forward = camera.axes
    lamp = -0.6 * forward - 0.45 * right + 0.75 * up
    light = np.clip(normals @ (lamp / np.linalg.norm(lamp)), 0.0, 1.0)
    gloss = 45.0 * light[:, None] ** 12
    colours = np.clip(shades[seen] * (AMBIENT + DIFFUSE * light)[:, None] + gloss, 0, 255)
    flat, depth = camera.project(corners.reshape(-1, 3))
    depths = depth.reshape(-1, 3).mean(axis=1) - nearer[seen]
    path, path_depth = camera.project(view.path)
    order = np.argsort(-np.concatenate([depths, 0.5 * (path_depth[1:] + path_depth[:-1])]))
    triangles = [tuple(map(tuple, triangle)) for triangle in flat.reshape(-1, 3, 2).tolist()]
    fills = [tuple(colour) for colour in colours.astype(int).tolist()]
    lines = [tuple(map(tuple, ends)) for ends in pairwise(path.tolist())]
    thick = max(2, round(camera.scale / DISTANCE * 0.011))
    for place in order.tolist():
        if place < len(triangles):
            draw.polygon(triangles[place], fill=fills[place], outline=fills[place])
        else:
            draw.line(lines[place - len(triangles)], fill=PATH, width=thick)


def _draw_shadows(
    draw: ImageDraw.ImageDraw, camera: Camera, view: MotionView, corners: Array
) -> None:
    points = corners.reshape(-1, 3)
    flat, _ = camera.project(points - np.outer(points @ view.up - view.floor, view.up))
    for triangle in flat.reshape(-1, 3, 2).tolist():
        draw.polygon(tuple(map(tuple, triangle)), fill=SHADOW)


def _draw_floor(draw: ImageDraw.ImageDraw, camera: Camera, view: MotionView) -> None:
    """Draw the floor as a grid around the robot."""
    along = camera.axes[0]
    other = np.cross(view.up, along)
    one = (along + other) / np.sqrt(2)
    two = (along - other) / np.sqrt(2)
    middle = view.centre + (view.floor - view.centre @ view.up) * view.up
    reach = 1.6 * view.radius
    for offset in np.linspace(-reach, reach, 13):
        for a, b in ((one, two), (two, one)):
            ends = np.stack([offset * a - reach * b, offset * a + reach * b]) + middle
            flat, _ = camera.project(ends)
            draw.line(tuple(map(tuple, flat.tolist())), fill=GRID, width=2)


def _place_points(view: MotionView, k: int, solid: Solid, points: Array) -> Array:
    if solid.link == ROOT:
        return points
    pose = view.poses[k, solid.link]
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _list_balls(view: MotionView) -> tuple[Array, NDArray[np.float64]]:
    """Return centres (N, 3) and radii (N,) of balls that hold everything drawn but the floor."""
    ends = [
        (end, solid.radius)
        for solid in (*view.solids, *view.stand)
        for end in place_ends(solid, view.poses)
    ]
    radii = [np.zeros(len(view.path)), *(np.full(len(end), radius) for end, radius in ends)]
    return np.concatenate([view.path, *(end for end, _ in ends)]), np.concatenate(radii)
