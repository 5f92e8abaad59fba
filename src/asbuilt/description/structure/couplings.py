"""Joints that follow others: how all links move with the joints that have a drive.

A follower has a link of its own and no drive: its position is `multiplier * position + offset` of
the joint that it follows. With the positions q of the driven joints, those of the joints of all
links are `E q + o`, so that by virtual work a torque at them acts on the driven joints by `E^T`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.structure.parts import (
    ROOT,
    DriveValues,
    Frame,
    Joint,
    JointLimits,
    Link,
)
from asbuilt.errors import DescriptionError


@dataclass(frozen=True, eq=False)
class Coupling:
    """Say how the joints of all links move with those that have a drive.

    The tree is the robot with a drive at every joint, its links in an order in which parents come
    first: link i of the tree is link `order[i]` of the robot (n_links,). The joints of the tree are
    at `matrix @ q + offset` for positions q of the driven joints, matrix (n_links, n_joints),
    offset (n_links,) in rad or m.
    """

    order: Indices
    matrix: Array
    offset: Array

    def positions(self, q: Array) -> Array:
        """Return the positions (N, n_links) of the joints of the tree for those (N, n_joints)."""
        return np.ascontiguousarray(q @ self.matrix.T + self.offset)

    def rates(self, qd: Array) -> Array:
        """Return velocities or accelerations (N, n_links) of the joints of the tree."""
        return np.ascontiguousarray(qd @ self.matrix.T)

    def torques(self, tau: Array) -> Array:
        """Return torques (..., n_joints) of the driven joints for those at the joints of the tree.

        Also the derivatives by their positions for those by the positions of the tree.
        """
        return np.ascontiguousarray(tau @ self.matrix)

    def matrices(self, of_tree: Array) -> Array:
        """Return `E^T A E` (..., n_joints, n_joints) for A (..., n_links, n_links) of the tree."""
        return np.ascontiguousarray(self.matrix.T @ of_tree @ self.matrix)

    def parameters(self, chi: Array) -> Array:
        """Return inertial parameters (..., n_links, 10) in the order of the tree."""
        return np.ascontiguousarray(chi[..., self.order, :])


@dataclass(frozen=True, eq=False)
class Separated:
    """Joints with a drive, those that follow them, links and frames in their order, and notes."""

    joints: tuple[Joint, ...]
    followers: tuple[Joint, ...]
    links: tuple[Link, ...]
    frames: tuple[Frame, ...]
    driven: tuple[int, ...]
    notes: tuple[str, ...]


def separated(
    robot: str,
    joints: Sequence[Joint],
    followers: Sequence[Joint],
    links: Sequence[Link],
    frames: Sequence[Frame],
) -> Separated:
    """Set the joints that follow others apart, with their links behind those of the driven joints.

    `driven` are the places among `joints` of those that stay. Armature and friction of a follower
    count to the joint that it follows, reflected by the multiplier, and its limits narrow that
    joint's. Raises `DescriptionError` for a joint that follows none of the robot, or itself.
    """
    tree_order(robot, joints, len(joints))
    driven = [k for k, joint in enumerate(joints) if joint.mimic is None]
    moved = [k for k, joint in enumerate(joints) if joint.mimic is not None]
    order = [*driven, *moved, *range(len(joints), len(links))]
    place = {was: now for now, was in enumerate(order)} | {ROOT: ROOT}
    every = [*joints, *followers]
    ordered = [replace(every[k], parent=place[every[k].parent]) for k in order]
    active = {joint.name: joint for joint in ordered[: len(driven)]}
    behind = ordered[len(driven) :]
    notes: list[str] = []
    for k, joint in enumerate(behind):
        assert joint.mimic is not None
        master, multiplier, offset = followed(robot, joint, ordered)
        if k >= len(moved):
            continue
        place_said = f"{offset:+.6g}" if offset else ""
        notes.append(
            f"joint {joint.name!r} follows {master!r} (position x {multiplier:.6g}{place_said}); it"
            " has no drive and needs no column in a log"
        )
        active[master], said = _driving(active[master], joint, multiplier, offset)
        notes += said
        behind[k] = replace(joint, drive=DriveValues())
    return Separated(
        joints=tuple(active.values()),
        followers=tuple(behind),
        links=tuple(links[k] for k in order),
        frames=tuple(replace(frame, link=place[frame.link]) for frame in frames),
        driven=tuple(driven),
        notes=tuple(notes),
    )


def followed(robot: str, joint: Joint, joints: Sequence[Joint]) -> tuple[str, float, float]:
    """Return the driven joint that a joint follows in the end, the multiplier and the offset.

    Raises `DescriptionError` where there is none.
    """
    by_name = {each.name: each for each in joints}
    multiplier, offset, seen = 1.0, 0.0, [joint.name]
    while joint.mimic is not None:
        offset += multiplier * joint.mimic.offset
        multiplier *= joint.mimic.multiplier
        if joint.mimic.joint not in by_name:
            raise DescriptionError(
                f"{robot}: joint {joint.name!r} mimics {joint.mimic.joint!r}, which does not exist;"
                f" the joints are {', '.join(by_name)}"
            )
        joint = by_name[joint.mimic.joint]
        if joint.name in seen:
            raise DescriptionError(
                f"{robot}: joint {seen[0]!r} mimics itself; name the joint it follows"
            )
        seen.append(joint.name)
    return joint.name, multiplier, offset


def tree_order(robot: str, joints: Sequence[Joint], n_driven: int) -> list[int]:
    """Return the links in an order in which parents come first, driven joints in their own order.

    Raises `DescriptionError` where there is none.
    """
    order: list[int] = []
    for joint in joints:
        if not ROOT <= joint.parent < len(joints):
            raise DescriptionError(
                f"{robot}: joint {joint.name!r} hangs on link index {joint.parent}; the links are 0"
                f" to {len(joints) - 1}, and {ROOT} for the root"
            )
    for link in range(len(joints)):
        waiting: list[int] = []
        at = link
        while at != ROOT and at not in order:
            if at in waiting or (at < n_driven and link < at):
                raise DescriptionError(
                    f"{robot}: joint {joints[link].name!r} (number {link + 1}) precedes its parent"
                    f" link (index {joints[link].parent})"
                )
            waiting.append(at)
            at = joints[at].parent
        order += reversed(waiting)
    return order


def coupling_of(robot: str, joints: Sequence[Joint], followers: Sequence[Joint]) -> Coupling:
    """Return how the links of a robot move with its driven joints."""
    every, names = (*joints, *followers), [joint.name for joint in joints]
    order = np.array(tree_order(robot, every, len(joints)), dtype=np.int64)
    matrix, offset = np.zeros((len(every), len(joints))), np.zeros(len(every))
    for i, link in enumerate(order.tolist()):
        master, multiplier, offset[i] = followed(robot, every[link], every)
        matrix[i, names.index(master)] = multiplier
    for array in (order, matrix, offset):
        array.setflags(write=False)
    return Coupling(order, matrix, offset)


def _driving(
    joint: Joint, follower: Joint, multiplier: float, offset: float
) -> tuple[Joint, list[str]]:
    """Return the driven joint with what its follower has of drive and limits."""
    notes, values = [], {}
    for name, share in (
        ("armature", multiplier**2),
        ("viscous", multiplier**2),
        ("coulomb", abs(multiplier)),
        ("offset", multiplier),
    ):
        if own := getattr(follower.drive, name):
            values[name] = (getattr(joint.drive, name) or 0.0) + share * own
    if values:
        notes.append(f"{', '.join(values)} of joint {follower.name!r} count to {joint.name!r}")
    if follower.drive.terms or follower.drive.kp is not None:
        notes.append(f"drive terms and servo of joint {follower.name!r} are left out")
    limits, said = _narrowed(joint, follower, multiplier, offset)
    return replace(joint, drive=replace(joint.drive, **values), limits=limits), [*notes, *said]


def _narrowed(
    joint: Joint, follower: Joint, multiplier: float, offset: float
) -> tuple[JointLimits, list[str]]:
    """Return the limits of a joint within those of its follower, unless no motion would be left."""
    own, other = joint.limits, follower.limits
    if not multiplier:
        return own, []
    lower, upper = sorted((end - offset) / multiplier for end in (other.lower, other.upper))
    rates = {
        name: min(getattr(own, name), getattr(other, name) / abs(multiplier))
        for name in ("velocity", "acceleration", "jerk")
        if getattr(other, name) > 0.0
    }
    lower, upper = max(own.lower, lower), min(own.upper, upper)
    if not lower < upper:
        return replace(own, **rates), [
            f"the position limits of joint {follower.name!r} leave {joint.name!r} no motion; they"
            " are left out"
        ]
    return replace(own, lower=lower, upper=upper, **rates), []
