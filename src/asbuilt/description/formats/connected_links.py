"""Links that joints connect, as URDF and SDF describe robots, and the robot that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.xml import close_match
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import (
    ROOT,
    DriveValues,
    Frame,
    Joint,
    JointKind,
    JointLimits,
    Link,
    Mimic,
    RobotModel,
)
from asbuilt.description.rotation import (
    SCALED,
    compose_placements,
    condense_notes,
    placement,
    rotation_onto,
)
from asbuilt.errors import DescriptionError
from asbuilt.findings import join_names

MOVING: dict[str, JointKind] = {
    "revolute": "revolute",
    "continuous": "continuous",
    "prismatic": "prismatic",
}
"""Kinds of joints that move, by their names in files."""
AXIS_TOLERANCE = 1e-6
"""An axis whose length differs from 1 by more is scaled to unit length with a note."""
Bodies = dict[str, LinkInertia | None]
"""The inertia of each link of the file by name, None where it gives none."""


@dataclass(frozen=True)
class Connection:
    """Say how a link hangs on another: fixed, or by a joint that moves.

    `origin` (4, 4) is the pose of the joint in the parent link, `joint` what moves there, from
    axes turned as its parent link's, and None where the link is fixed.
    """

    name: str
    parent: str
    child: str
    origin: Array
    joint: Joint | None


def build_robot(
    name: str, bodies: Bodies, connections: list[Connection], source: str, notes: list[str]
) -> RobotModel:
    """Return the robot of links that joints connect; links behind fixed ones become parts.

    Raises `DescriptionError`, which names `source`, where they are no tree in which a joint moves.
    """
    for connection in connections:
        place = f"{source}, joint {connection.name!r}"
        for end, link in (("parent", connection.parent), ("child", connection.child)):
            if link not in bodies:
                raise DescriptionError(
                    f"{place}: the {end} link {link!r} does not exist{close_match(link, bodies)}"
                )
        if connection.parent == connection.child:
            raise DescriptionError(
                f"{place}: the joint connects link {connection.parent!r} with itself"
            )
    top = _find_root_link(bodies, connections, source)
    tree = _merge_fixed(top, bodies, connections, source)
    if not tree.joints:
        raise DescriptionError(
            f"{source}: no joint moves (revolute, continuous or prismatic), so there is nothing to"
            " identify"
        )
    _drop_fixed_mimics(tree.joints, connections, notes)
    links = [
        Link.of_parts(name, parts, known=bool(parts))
        for name, parts in zip(tree.links, tree.parts, strict=True)
    ]
    return RobotModel(
        drives_by_design=False,
        name=name,
        joints=tuple(tree.joints),
        links=tuple(links),
        root_link=top,
        frames=tuple(tree.frames),
        source=source,
        notes=condense_notes([note.replace(f"{source}, ", "") for note in notes]),
    )


def _find_root_link(bodies: Bodies, connections: list[Connection], source: str) -> str:
    children = {connection.child for connection in connections}
    tops = [name for name in bodies if name not in children]
    if not tops:
        raise DescriptionError(
            f"{source}: every link is the child of a joint, so the joints form a loop; one link"
            " must be the root"
        )
    if len(tops) > 1:
        raise DescriptionError(
            f"{source}: {len(tops)} links have no parent joint"
            f" ({', '.join(repr(name) for name in tops[:5])}); a robot has one root: connect the"
            " others to it"
        )
    return tops[0]


@dataclass
class _Tree:
    """Gather what has been merged so far; `parts[i]` belong to moving link i, in its frame."""

    joints: list[Joint] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    parts: list[list[tuple[str, LinkInertia]]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)


def _merge_fixed(top: str, bodies: Bodies, connections: list[Connection], source: str) -> _Tree:
    """Return the tree of moving links below a root, in which fixed ones are parts of others."""
    tree = _Tree()
    below: dict[str, list[Connection]] = {}
    for connection in connections:
        below.setdefault(connection.parent, []).append(connection)
    reached = {top}
    waiting = [(connection, ROOT, np.eye(4)) for connection in reversed(below.get(top, []))]
    while waiting:
        connection, carrier, parent_pose = waiting.pop()
        pose = compose_placements(parent_pose, connection.origin)
        name = connection.child
        inertia = bodies[connection.child]
        reached.add(name)
        if connection.joint is None:
            tree.frames.append(Frame(name=name, link=carrier, placement=pose))
            if carrier != ROOT and inertia is not None:
                tree.parts[carrier].append((name, inertia.moved(pose)))
        else:
            before = compose_placements(pose, connection.joint.before)
            tree.joints.append(replace(connection.joint, parent=carrier, before=before))
            tree.links.append(name)
            tree.parts.append([(name, inertia)] if inertia is not None else [])
            carrier = len(tree.joints) - 1
            pose = np.eye(4)
        waiting.extend((after, carrier, pose) for after in reversed(below.get(name, [])))
    if len(reached) < len(bodies):
        lost = next(name for name in bodies if name not in reached)
        raise DescriptionError(
            f"{source}: link {lost!r} cannot be reached from the root link {top!r}; its joints form"
            " a loop"
        )
    return tree


def _drop_fixed_mimics(
    joints: list[Joint], connections: list[Connection], notes: list[str]
) -> None:
    """Let joints that follow a fixed one, which stands still, have a motor."""
    fixed = {connection.name for connection in connections if connection.joint is None}
    for k, joint in enumerate(joints):
        if joint.mimic is not None and not fixed.isdisjoint(joint.mimic.factors):
            joints[k] = replace(joint, mimic=None)
            notes.append(
                f"joint {joint.name!r}: the joint mimics a fixed joint; <mimic> is left out"
            )


def make_joint(
    name: str,
    kind: JointKind,
    axis: Array,
    *,
    after: Array | None = None,
    limits: JointLimits,
    drive: DriveValues,
    mimic: Mimic | None,
) -> Joint:
    """Return a joint about or along a unit axis (3,), which no link carries yet.

    `after` (4, 4) is the pose of its link in the axes of `axis`, the same by default.
    """
    onto = rotation_onto(axis)
    back = placement(onto.T) if after is None else compose_placements(placement(onto.T), after)
    return Joint(name, kind, ROOT, placement(onto), back, limits, drive, mimic=mimic)


def scale_axis(given: Sequence[float], place: str, notes: list[str]) -> Array:
    """Return the unit vector along an axis, with a note where its length is another.

    Raises `DescriptionError`, which names `place`, where it has no direction.
    """
    length = float(np.linalg.norm(given))
    if length == 0.0:
        raise DescriptionError(
            f"{place}: the axis is {[*given]} and has no direction; give a unit vector such as"
            ' xyz="0 0 1"'
        )
    if abs(length - 1.0) > AXIS_TOLERANCE:
        notes.append(f"{place}: the axis {[*given]} has length {length:.6g} {SCALED}")
    return np.asarray(given) / length


def bound_joint(
    kind: JointKind, given: Mapping[str, float], place: str, notes: list[str]
) -> JointLimits:
    """Return the limits of a joint by `lower`, `upper`, `velocity` and `effort`, as far as given.

    Raises `DescriptionError`, which names `place`, where they make no sense.
    """
    # Exporters of CAD programs write zeros for what nobody stated.
    zero = [name for name in ("velocity", "effort") if given.get(name) == 0.0]
    lower = given.get("lower", -np.inf)
    upper = given.get("upper", np.inf)
    if kind == "continuous" or lower == upper == 0.0:
        zero = zero if kind == "continuous" else ["position", *zero]
        lower = -np.inf
        upper = np.inf
    if lower > upper:
        raise DescriptionError(
            f"{place}: lower limit {lower} exceeds upper limit {upper}; swap them"
        )
    for name in ("velocity", "effort"):
        if given.get(name, 0.0) < 0.0:
            raise DescriptionError(f"{place}: {name} limit is {given[name]}; it must be positive")
    if zero:
        notes.append(f"{place}: limits of {join_names(zero)} are 0, taken as not stated")
    velocity, torque = (given.get(name) or np.inf for name in ("velocity", "effort"))
    return JointLimits(lower=lower, upper=upper, velocity=velocity, torque=torque)


def describe_drive(given: Mapping[str, float], place: str) -> DriveValues:
    """Return the drive of a joint by `damping` and `friction`, as far as given.

    Raises `DescriptionError`, which names `place`, where one is negative.
    """
    for name, value in given.items():
        if value < 0.0:
            raise DescriptionError(f"{place}: {name} is {value}; it must not be negative")
    return DriveValues(viscous=given.get("damping"), coulomb=given.get("friction"))
