"""Size of links where there are no meshes: to draw them, and as units of tolerances.

Rods and housings from its geometry, ellipsoids from its inertias.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, RobotModel

SLENDERNESS = 0.062
"""Radius of the thickest rod, in lengths of the stretched robot."""
TAPER = 0.5
"""How much thinner than the first rod the last one is."""
SHORTEST = 1e-3
"""Rods shorter than this are not drawn [m]."""
BEND = 0.35
"""Share of a link's length that has to lie along its joint axis, and square to it, for the link to
be drawn with a corner.
"""
TRAVEL = 0.3
"""Length of a sliding rod whose travel is not limited [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """Describe a round body fixed to a link (ROOT for the root link).

    It reaches from `start` to `stop` (3,), in link axes [m], with `radius` [m].

    A `rod` has round ends, a `housing` sits around a joint axis and has flat ones.
    """

    link: int
    kind: Literal["rod", "housing"]
    start: Array
    stop: Array
    radius: float

    @property
    def length(self) -> float:
        """Distance between the ends [m]."""
        return float(np.linalg.norm(self.stop - self.start))


def link_solids(model: RobotModel) -> tuple[Solid, ...]:
    """Return what stands in for the robot's shape.

    A rod along each link to whatever hangs on it, and a housing around each joint axis.

    Radii come from the length of the stretched robot and shrink towards the tip. They are for the
    eye alone: no collision.
    """
    return tuple(_build_solids(model))


def stretched_length(model: RobotModel) -> float:
    """Return the length of the longest chain from the root, joint by joint [m]; at least 0.1."""
    return max(0.1, float(np.max(measure_distances(model))))


def inertia_ellipsoid(inertia: LinkInertia) -> tuple[Array, Array] | None:
    """Return the ellipsoid of uniform density with this inertia, centred at the centre of mass.

    Semi-axes (3,) [m] and axes (3, 3), as columns in link axes.

    It sits at the centre of mass: `I_1 = m (b^2 + c^2) / 5` and cyclically, so `a^2 = 5 (I_2 + I_3
    - I_1) / (2 m)`. None where no body of positive mass has this inertia.
    """
    if not inertia.mass > 0.0 or not inertia.is_consistent:
        return None
    moments, axes = inertia.principal_axes
    squares = 2.5 * (moments.sum() - 2.0 * moments) / inertia.mass
    return np.sqrt(np.maximum(squares, 0.0)), axes


def _build_solids(model: RobotModel) -> Iterator[Solid]:
    distances = measure_distances(model)
    reach = stretched_length(model)
    thick = SLENDERNESS * reach
    ends: dict[int, list[Array]] = {k: [] for k in range(ROOT, model.n_links)}
    for joint in model.moving_joints:
        ends[joint.parent].append(joint.before[:3, 3])
    for frame in model.frames:
        if frame.link == ROOT or not ends[frame.link]:
            ends[frame.link].append(frame.placement[:3, 3])
    for at, point in model.joined_points:
        if at != ROOT:
            ends[at].append(point)
    for end in ends[ROOT]:
        if np.linalg.norm(end) > thick:
            yield Solid(ROOT, "rod", np.zeros(3), end, thick)
    for k, (joint, link) in enumerate(zip(model.moving_joints, model.links, strict=True)):
        radius = thick * (1.0 - TAPER * float(distances[k]) / reach)
        axis = joint.after[2, :3]
        origin = -joint.after[:3, :3].T @ joint.after[:3, 3]
        if joint.is_revolute:
            yield Solid(
                k,
                "housing",
                origin - 1.25 * radius * axis,
                origin + 1.25 * radius * axis,
                1.12 * radius,
            )
        else:
            travel = joint.limits.upper - joint.limits.lower
            back = travel if np.isfinite(travel) else TRAVEL
            yield Solid(k, "rod", origin - back * axis, origin, 0.7 * radius)
        for point in ends[k] or [link.inertia.com]:
            for start, stop in _build_rods(origin, point, axis):
                yield Solid(k, "rod", start, stop, 0.82 * radius)


def _build_rods(origin: Array, point: Array, axis: Array) -> Iterator[tuple[Array, Array]]:
    """Yield the pieces from the joint to a point on the link.

    Along the axis and then square to it where both are long, else straight.
    """
    along = ((point - origin) @ axis) * axis
    across = point - origin - along
    corners = [origin, point]
    if min(np.linalg.norm(along), np.linalg.norm(across)) > BEND * np.linalg.norm(point - origin):
        corners.insert(1, origin + along)
    for start, stop in pairwise(corners):
        if np.linalg.norm(stop - start) > SHORTEST:
            yield start, stop


def measure_distances(model: RobotModel) -> Array:
    """Return how far along the chain each link ends, shape (n_links,) [m]."""
    along = np.zeros(model.n_links)
    for k in model.link_order:
        joint = model.moving_joints[k]
        before = 0.0 if joint.parent == ROOT else along[joint.parent]
        own = np.linalg.norm(joint.before[:3, 3]) + np.linalg.norm(joint.after[:3, 3])
        tip = max(
            (np.linalg.norm(frame.placement[:3, 3]) for frame in model.frames if frame.link == k),
            default=0.0,
        )
        along[k] = before + own + tip
    return along


class SizeUnits(NamedTuple):
    """Hold a unit of length [m] and one of mass [kg]."""

    length: float
    mass: float

    def torque(self, *, revolute: bool) -> float:
        """Return the unit of torque or force at a joint [N m or N]."""
        return self.mass * self.length ** (2 if revolute else 1)


def find_size_units(model: RobotModel) -> SizeUnits:
    """Return the millimetre, metre or kilometre, and the microgram, kilogram or megatonne.

    The nearest to the length of the longest chain and to the mass of all links, one and one for
    arms from 3 cm to 30 m and from 32 mg to 32 t: steps of mass are cubes of those of length, and
    all arms that are sold lie within one. Numbers of such arms are then the same whatever their
    size.
    """
    masses = [link.inertia.mass for link in model.links if link.inertia.mass > 0.0]
    return SizeUnits(
        find_prefix(float(np.max(measure_distances(model), initial=0.0)), 1e3),
        find_prefix(float(np.sum(masses)), 1e9),
    )


def find_prefix(size: float, step: float) -> float:
    """Return the power of a step that is nearest to a size by its logarithm; 1 of nothing."""
    return float(step ** round(np.log(size) / np.log(step))) if size > 0.0 else 1.0
