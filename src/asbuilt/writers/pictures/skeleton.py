"""A robot and its motion drawn without OpenGL: poses, path of the tip, shaded rods and housings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image as Pillow
from PIL import ImageDraw

from asbuilt.arrays import Array, Image, find_finite_rows
from asbuilt.description import ROOT, RobotModel, Solid, link_solids, rotation_onto
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import Motion, MotionBounds, SplineMotion
from asbuilt.experiment import Recording, RecordingStream, head_of


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


BODY_COLOURS = {"rod": (196, 201, 208), "housing": (236, 128, 36)}
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
    colours = [BODY_COLOURS[solid.kind] for solid in view.solids] + [STAND] * len(view.stand)
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


FEWEST_POSES = 6


@dataclass(frozen=True, slots=True, eq=False)
class MotionView:
    """Poses of a motion and the scene around them.

    `t` (N,), `q` (N, n), `poses` (N, n, 4, 4) in the root frame, `path` (m, 3) of the tip [m].

    `up` is the direction against gravity, `floor` the height of the ground along it, `centre` and
    `radius` a ball that encloses every pose.
    """

    t: Array
    q: Array
    poses: Array
    path: Array
    solids: tuple[Solid, ...]
    up: Array
    floor: float
    centre: Array
    radius: float

    @classmethod
    def of(
        cls, model: RobotModel, t: ArrayLike, q: ArrayLike, *, path: ArrayLike | None = None
    ) -> MotionView:
        """Build from times (N,) and joint positions (N, n).

        `path` (m, n) are the positions of a finer path, by default q.
        """
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        positions = np.atleast_2d(np.asarray(q, dtype=np.float64))
        if positions.shape != (times.size, model.n_joints) or not np.all(np.isfinite(positions)):
            raise UsageError(
                f"a view of {model.name} needs finite positions of shape ({times.size},"
                f" {model.n_joints}), got {positions.shape}"
            )
        poses = link_poses(model, positions)
        along = poses if path is None else link_poses(model, np.asarray(path))
        solids = link_solids(model)
        strength = np.linalg.norm(model.gravity)
        up = -model.gravity / strength if strength > 0 else np.array([0.0, 0.0, 1.0])
        ends = np.concatenate(
            [np.zeros((1, 3)), *(end for solid in solids for end in place_ends(solid, along))]
        )
        thickest = max(solid.radius for solid in solids)
        low = ends.min(axis=0) - thickest
        high = ends.max(axis=0) + thickest
        floor = min(0.0, float(np.min(ends @ up)) - thickest)
        last, place = _find_tip(model)
        traced = along[:, last]
        return cls(
            t=times,
            q=positions,
            poses=poses,
            path=traced[:, :3, :3] @ place + traced[:, :3, 3],
            solids=solids,
            up=up,
            floor=0.0 if floor > -0.6 * thickest - thickest else floor,
            centre=0.5 * (low + high),
            radius=0.5 * float(np.linalg.norm(high - low)),
        )

    @classmethod
    def of_motion(
        cls, model: RobotModel, motion: Motion | None, *, most: int = 200, rate: float = 25.0
    ) -> MotionView:
        """Build from a motion, at `rate` [Hz] or as many frames as `most`.

        Without a motion the robot rests near the middle of its ranges.
        """
        if motion is None:
            return cls.of(model, [0.0], choose_resting_pose(model)[None])
        t = np.linspace(
            0.0, motion.duration, int(np.clip(np.ceil(motion.duration * rate), 2, most))
        )
        # 1000: most points of the drawn path of the tip.
        fine = np.linspace(0.0, motion.duration, int(np.clip(40 * motion.duration, 200, 1000)))
        return cls.of(model, t, motion.derivative(t, 0), path=motion.derivative(fine, 0))

    @property
    def stand(self) -> tuple[Solid, ...]:
        """Base plate on the floor, and column up to the robot if there is one."""
        thickest = max(solid.radius for solid in self.solids)
        foot = self.floor * self.up
        plate = Solid(ROOT, "housing", foot, foot + 0.25 * thickest * self.up, 2 * thickest)
        column = Solid(ROOT, "housing", foot, np.zeros(3), 1.15 * thickest)
        return (plate, column) if self.floor < 0.0 else (plate,)

    def first(self) -> MotionView:
        """Return the same view with its first frame alone."""
        return replace(self, t=self.t[:1], q=self.q[:1], poses=self.poses[:1])


def choose_resting_pose(model: RobotModel) -> Array:
    """Return the zero position, bent and moved into the joints' ranges, shape (n,).

    Bent, no two axes hide each other.
    """
    bounds = MotionBounds.assumed(model)
    bend = [
        0.35 * (-1) ** k if k and joint.is_revolute else 0.0 for k, joint in enumerate(model.joints)
    ]
    margin = 0.1 * (bounds.upper - bounds.lower)
    return np.asarray(np.clip(bend, bounds.lower + margin, bounds.upper - margin))


def motion_of_recording(recording: Recording | RecordingStream) -> SplineMotion:
    """Return the motion through the positions of a recording, of the beginning of a long one.

    Raises `MotionError` if there are fewer than 6 samples without gaps.
    """
    head = head_of(recording)
    valid = find_finite_rows(head.t, head.q)
    t = head.t[valid]
    q = head.q[valid]
    if len(t) < FEWEST_POSES:
        raise MotionError(f"{head.source} has {len(t)} valid positions; at least 6 can be played")
    # 25 poses per second, the eye sees no more; motions beyond two minutes have larger steps.
    wanted = max(FEWEST_POSES, min(3000, int(25.0 * (t[-1] - t[0]))))
    chosen = np.unique(np.linspace(0, len(t) - 1, wanted).round().astype(int))
    return SplineMotion.through(q[chosen], t[chosen] - t[0], degree=3, ends="natural")


def place_ends(solid: Solid, poses: Array) -> list[Array]:
    """Return both ends (N, 3) of a body at poses (N, n, 4, 4) of the links; (1, 3) of the base."""
    if solid.link == ROOT:
        return [solid.start[None], solid.stop[None]]
    pose = poses[:, solid.link]
    return [pose[:, :3, :3] @ end + pose[:, :3, 3] for end in (solid.start, solid.stop)]


def _find_tip(model: RobotModel) -> tuple[int, Array]:
    """Return the link of the tool and the point whose path is drawn: a frame, or its origin."""
    last = model.tool_link
    on_it = [frame.placement[:3, 3] for frame in model.frames if frame.link == last]
    return last, np.asarray([np.zeros(3), *on_it][-1])
