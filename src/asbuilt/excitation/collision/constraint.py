"""Constraints on the place of bodies: collisions, and a box for the tool."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.collision.capsules import Surroundings, build_surroundings, list_neighbours
from asbuilt.excitation.collision.distances import find_nearest_on_segments, find_nearest_to_box
from asbuilt.excitation.information.information import draw_states
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.point_to_point import CHECK_RATE
from asbuilt.excitation.state_constraint import StateConstraint
from asbuilt.findings import Cure

SOFTNESS = 0.1
"""Distance beyond the clearance over which a body matters to a design [m]."""


POSES_AT_ONCE = 4000
"""Poses evaluated together, for memory."""


class CollisionGuard(StateConstraint):
    """Keep every pair of bodies at least the clearance c apart.

    `v = 1 - tanh((d - c) / 0.1 m)` must stay below 1.

    Links joined by a joint, pairs that are allowed to touch, and pairs that touch in nearly every
    pose are not checked; `left_out` names the last.
    """

    name = "collision"
    two_sided = False

    def __init__(self, model: RobotModel, bodies: Surroundings) -> None:
        self._model = model
        self._bodies = bodies
        joined = list_neighbours(model) | bodies.allowed
        links = [capsule.link for capsule in bodies.capsules]
        self.pairs = [
            (a, b)
            for a, b in combinations(range(len(links)), 2)
            if links[a] != links[b] and frozenset((links[a], links[b])) not in joined
        ]
        self.pairs += [
            (a, len(links) + b)
            for b in range(len(bodies.obstacles))
            for a in range(len(links))
            if links[a] != ROOT
        ]
        # Random poses in which it is found which bodies always touch.
        poses = draw_states(MotionBounds.assumed(model), 200, np.random.default_rng(0))[0]
        # Share of random poses above which a pair closer than the clearance touches by
        # construction.
        close = (self._measure_distances(poses)[0] < bodies.clearance).mean(axis=0) > 0.9
        names = [model.root_link if link == ROOT else model.link_names[link] for link in links]
        names += [obstacle.name for obstacle in bodies.obstacles]
        self.left_out = tuple(
            f"{names[a]} - {names[b]}"
            for (a, b), always in zip(self.pairs, close, strict=True)
            if always
        )
        self.pairs = [pair for pair, always in zip(self.pairs, close, strict=True) if not always]
        if not self.pairs:
            raise MotionError(
                f"{model.name}: no pair of bodies is left that could collide; check the capsules"
                " and the pairs allowed to touch"
            )

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return v of every pair, (N, pairs)."""
        beyond = self._measure_distances(q)[0] - self._bodies.clearance
        return np.asarray(1.0 - np.tanh(beyond / SOFTNESS))

    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivative of v by q (N, pairs, n, 1), by Jacobians at nearest points."""
        distances, points, normals = self._measure_distances(q)
        slope = -(1 - np.tanh((distances - self._bodies.clearance) / SOFTNESS) ** 2) / SOFTNESS
        gradient = np.zeros((*distances.shape, self._model.n_joints))
        frames = _place_joint_axes(self._model, q)
        for number, (a, b) in enumerate(self.pairs):
            for body, point, sign in (
                (a, points[:, number, 0], -1.0),
                (b, points[:, number, 1], 1.0),
            ):
                link = (
                    self._bodies.capsules[body].link if body < len(self._bodies.capsules) else ROOT
                )
                for speed, shares in _list_speeds(self._model, frames, link, point):
                    away = sign * np.einsum("si,si->s", normals[:, number], speed)
                    gradient[:, number] += away[:, None] * shares
        return np.asarray(slope[:, :, None, None] * gradient[..., None])

    def smallest_distance(self, q: Array) -> float:
        """Return the smallest distance between any checked pair over all poses (N, n) [m]."""
        return float(self._measure_distances(q)[0].min())

    def notes(self, q: Array, qd: Array, qdd: Array) -> tuple[str, ...]:
        """Name the pairs that are not checked."""
        if not self.left_out:
            return ()
        return (f"NOT CHECKED, they touch in nearly every pose: {', '.join(self.left_out)}",)

    def _measure_distances(self, q: Array) -> tuple[Array, Array, Array]:
        """Return distances (N, pairs), nearest axis points (N, pairs, 2, 3) and normals between."""
        links = link_poses(self._model, q)
        ends = []
        for capsule in self._bodies.capsules:
            if capsule.link == ROOT:
                ends.append(
                    tuple(
                        np.broadcast_to(end, (len(q), 3))
                        for end in (capsule.start, capsule.stop - capsule.start)
                    )
                )
            else:
                rotation = links[:, capsule.link, :3, :3]
                origin = links[:, capsule.link, :3, 3]
                ends.append(
                    (rotation @ capsule.start + origin, rotation @ (capsule.stop - capsule.start))
                )
        samples = len(q)
        count = len(self.pairs)
        n_capsules = len(self._bodies.capsules)
        distances = np.empty((samples, count))
        points = np.zeros((samples, count, 2, 3))
        normals = np.empty((samples, count, 3))
        among = [place for place, (_, b) in enumerate(self.pairs) if b < n_capsules]
        if among:
            first, second = ([self.pairs[place][side] for place in among] for side in (0, 1))
            stacks = [
                np.stack([ends[body][part] for body in bodies], axis=1).reshape(-1, 3)
                for bodies in (first, second)
                for part in (0, 1)
            ]
            near = [point.reshape(samples, -1, 3) for point in find_nearest_on_segments(*stacks)]
            apart = near[1] - near[0]
            size = np.sqrt((apart**2).sum(axis=2))
            radii = [
                self._bodies.capsules[a].radius + self._bodies.capsules[b].radius
                for a, b in zip(first, second, strict=True)
            ]
            distances[:, among] = size - np.array(radii)
            normals[:, among] = apart / np.maximum(size, 1e-12)[:, :, None]
            points[:, among, 0], points[:, among, 1] = near
        for number, (a, b) in enumerate(self.pairs):
            if b >= n_capsules:
                obstacle = self._bodies.obstacles[b - n_capsules]
                rotation = obstacle.pose[:3, :3]
                middle = obstacle.pose[:3, 3]
                point, distance, normal = find_nearest_to_box(
                    (ends[a][0] - middle) @ rotation, ends[a][1] @ rotation, obstacle.size / 2
                )
                distances[:, number] = distance - self._bodies.capsules[a].radius
                normals[:, number] = -normal @ rotation.T
                points[:, number, 0] = point @ rotation.T + middle
        return distances, points, normals


class ToolBox(StateConstraint):
    """Keep a point fixed to a link, a frame's origin, within a box of the root frame.

    `|x - centre| / half` below 1 along each axis.
    """

    name = "tool box"
    two_sided = True

    def __init__(
        self, model: RobotModel, lower: Array, upper: Array, frame: str | None = None
    ) -> None:
        self._model = model
        named = {name: place for name, place in model.places.items() if place[0] != ROOT}
        last = (
            model.frames[-1].name
            if model.frames and model.frames[-1].link != ROOT
            else model.link_names[model.tool_link]
        )
        if (frame or last) not in named:
            raise MotionError(
                f"{model.name} has no moving frame {frame!r}; it has {', '.join(named)}"
            )
        self._link, pose = named[frame or last]
        self._point = pose[:3, 3]
        if not np.all(upper > lower):
            raise MotionError(
                f"the box of the tool must have positive extent, got {lower.tolist()} to"
                f" {upper.tolist()}"
            )
        self._centre = (upper + lower) / 2
        self._half = (upper - lower) / 2

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the normalised place of the tool, (N, 3)."""
        return np.asarray((self._place_tool(q) - self._centre) / self._half)

    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivatives of the place by q, (N, 3, n, 1)."""
        place = self._place_tool(q)
        gradient = np.zeros((len(q), 3, self._model.n_joints))
        frames = _place_joint_axes(self._model, q)
        for speed, shares in _list_speeds(self._model, frames, self._link, place):
            gradient += (speed / self._half)[:, :, None] * shares
        return gradient[..., None]

    def margin(self, q: Array) -> float:
        """Return the smallest distance to a side of the box over poses [m]; negative outside."""
        return float((self._half - np.abs(self._place_tool(q) - self._centre)).min())

    def notes(self, q: Array, qd: Array, qdd: Array) -> tuple[str, ...]:
        """State the margin to the box."""
        return (f"the tool keeps {1000 * self.margin(q):.0f} mm from the sides of its box",)

    def _place_tool(self, q: Array) -> Array:
        pose = link_poses(self._model, q)[:, self._link]
        return np.asarray(pose[:, :3, :3] @ self._point + pose[:, :3, 3])


def build_constraints(
    model: RobotModel,
    *,
    collision: str | None = None,
    tool_box: Sequence[float] = (),
    tool_frame: str | None = None,
) -> tuple[StateConstraint, ...]:
    """Return the constraints for bodies and for a box of the tool; arguments of `DesignOptions`."""
    found: list[StateConstraint] = []
    if collision is not None:
        found.append(CollisionGuard(model, build_surroundings(model, collision)))
    if tool_box:
        if len(tool_box) != 6:
            raise UsageError(
                f"the box of the tool has six numbers, x0, x1, y0, y1, z0, z1; got {len(tool_box)}"
            )
        edges = np.array(tool_box, dtype=np.float64).reshape(3, 2)
        found.append(ToolBox(model, edges[:, 0], edges[:, 1], tool_frame))
    return tuple(found)


def skeleton_distance(model: RobotModel, q: Array) -> float | None:
    """Return the smallest distance between the robot's own capsules over poses (N, n) [m].

    None if it has no capsules that could meet.
    """
    try:
        return CollisionGuard(model, build_surroundings(model, "skeleton")).smallest_distance(q)
    except MotionError:
        return None


def _place_joint_axes(model: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return the direction of each link's joint axis and a point on it, both (N, n_links, 3).

    In the root frame.
    """
    links = link_poses(model, q)
    axes = np.empty((len(q), model.n_links, 3))
    origins = np.empty((len(q), model.n_links, 3))
    for k, joint in enumerate(model.moving_joints):
        frame = (
            np.broadcast_to(joint.before, (len(q), 4, 4))
            if joint.parent == ROOT
            else links[:, joint.parent] @ joint.before
        )
        axes[:, k] = frame[:, :3, 2]
        origins[:, k] = frame[:, :3, 3]
    return axes, origins


def _list_speeds(
    model: RobotModel, frames: tuple[Array, Array], link: int, point: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield the speed (N, 3) of a point (N, 3) of a link per rate of each joint that moves it.

    With it come the shares (n,) of the coordinates in that joint; `frames` of `_place_joint_axes`.
    """
    axes, origins = frames
    for k in model.ancestors(link):
        turns = model.moving_joints[k].is_revolute
        speed = np.cross(axes[:, k], point - origins[:, k]) if turns else axes[:, k]
        yield speed, model.link_shares[k]


@dataclass(frozen=True)
class Clearance:
    """Smallest `distance` [m] between the bodies of `source` along a motion.

    `obstacles` are bodies other than the robot's, `left_out` pairs that always touch.
    """

    source: str
    distance: float
    obstacles: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def measure_clearance(model: RobotModel, motion: Motion, source: str) -> Clearance:
    """Return the smallest distance on a 1 kHz grid between the bodies of `source`.

    Raises
    ------
    MotionError
        If bodies of pairs that are checked touch.
    """
    bodies = build_surroundings(model, source)
    guard = CollisionGuard(model, bodies)
    t = np.linspace(0.0, motion.duration, int(np.ceil(motion.duration * CHECK_RATE)) + 1)
    parts = np.array_split(t, max(1, len(t) // POSES_AT_ONCE))
    nearest = [guard.smallest_distance(motion.derivative(part)) for part in parts]
    distance = min(nearest)
    if distance <= 0.0:
        part = parts[int(np.argmin(nearest))]
        raise MotionError(
            f"bodies of {source} overlap by {-1000 * distance:.0f} mm between t = {part[0]:.2f} and"
            f" {part[-1]:.2f} s of the motion",
            cure=Cure("design a motion that keeps them apart", {"collision": source}),
            distance=distance,
        )
    return Clearance(
        source, distance, tuple(obstacle.name for obstacle in bodies.obstacles), guard.left_out
    )
