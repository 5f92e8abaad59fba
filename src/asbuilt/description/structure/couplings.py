"""Linear couplings: how joints and motors that are no joints move with the coordinates of a robot.

The coordinates q are what a log has a column of: motors, or joints that have a motor. The joints of
all links, the coordinates of the tree of bodies, are at `A q + b`, so that by virtual work torques
at them act on the coordinates by `A^T`. A joint that follows others (parallelograms, mimic joints)
has no coordinate; one that several motors turn (wrists) has its own and depends on others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.structure.joint_map import JointMap, TreeMotion
from asbuilt.description.structure.parts import (
    ROOT,
    DriveValues,
    Joint,
    JointLimits,
    Link,
    Mimic,
)
from asbuilt.description.structure.robot import RobotParts, order_tree
from asbuilt.errors import DescriptionError

Robot = TypeVar("Robot", bound=RobotParts)


@dataclass(frozen=True, eq=False)
class Coupling(JointMap):
    """Say that the joints of all links move with the coordinates in constant shares.

    The joints of the tree are at `matrix @ q + offset`, matrix (n_links, n_joints), offset
    (n_links,) in rad or m.
    """

    order: Indices
    matrix: Array
    offset: Array

    def motion(self, q: Array, qd: Array | None = None, qdd: Array | None = None) -> TreeMotion:
        """Return the motion of the joints of the tree; rates not given are zero."""
        at = np.ascontiguousarray(q @ self.matrix.T + self.offset)
        rates = [
            np.zeros_like(at) if part is None else np.ascontiguousarray(part @ self.matrix.T)
            for part in (qd, qdd)
        ]
        return TreeMotion(at, rates[0], rates[1], self.matrix)

    @property
    def of_links(self) -> Array:  # type: ignore[override]
        """The rows of `matrix` in the order of the robot's links, (n_links, n_joints)."""
        return self.matrix[np.argsort(self.order)]


def separate_followers(model: RobotParts) -> dict[str, object]:
    """Set the joints that follow others apart, with their links after the driven joints' links.

    Returns the fields of the robot that change. Armature and friction of a follower of one joint
    count to that joint, reflected by the factor, and its limits narrow that joint's; a follower of
    several loses its own. Raises `DescriptionError` for a joint that follows none of the robot, or
    itself.
    """
    robot = model.name
    joints = model.joints
    # A wrong order is said in its own words before anything is moved.
    order_tree(robot, joints, len(joints))
    driven = [k for k, joint in enumerate(joints) if joint.has_motor]
    moved = [k for k, joint in enumerate(joints) if not joint.has_motor]
    further = range(len(joints), len(model.links))
    ordered, links, frames = model.in_order([*driven, *moved, *further])
    active = {joint.name: joint for joint in ordered[: len(driven)]}
    behind = [*ordered[len(driven) :]]
    notes: list[str] = []
    # Followers without a motor among the joints come first behind them.
    for k, joint in enumerate(behind[: len(moved)]):
        if joint.is_passive:
            notes += _note_passive(joint)
            behind[k] = replace(joint, drive=DriveValues())
            continue
        factors, offset = resolve_coupling(robot, joint, ordered)
        notes.append(
            f"joint {joint.name!r} follows {_format_sum(factors, offset)}; it has no drive and"
            " needs no column in a log"
        )
        # One master takes drive and limits over; of several none could say how much.
        if len(factors) == 1 and next(iter(factors)) in active:
            master, multiplier = next(iter(factors.items()))
            active[master], said = _take_over_drive(active[master], joint, multiplier, offset)
            notes += said
        elif joint.drive != DriveValues() or joint.limits != JointLimits():
            notes.append(
                f"drive and limits of joint {joint.name!r}, which several others move, are left out"
            )
        behind[k] = replace(joint, drive=DriveValues())
    return {
        "joints": tuple(active.values()),
        "followers": tuple(behind),
        "links": links,
        "frames": frames,
        "motor_coupling": _drop_followers(model, driven, moved),
        "notes": (*model.notes, *(note for note in notes if note not in model.notes)),
    }


def _drop_followers(model: RobotParts, driven: list[int], moved: list[int]) -> Array | None:
    """Return the coupling of motors without the joints that have none."""
    T = None if model.motor_coupling is None else np.asarray(model.motor_coupling)
    # Of another shape it is refused with that of the robot.
    if T is None or T.shape != (len(model.joints),) * 2:
        return T
    if not np.array_equal(T[moved], np.eye(len(T))[moved]) or np.any(T[np.ix_(driven, moved)]):
        raise DescriptionError(
            f"{model.name}: motor_coupling names joint {model.joints[moved[0]].name!r}, which"
            " follows another and has no motor; leave it out"
        )
    return T[np.ix_(driven, driven)]


def _note_passive(joint: Joint) -> Iterator[str]:
    """Yield what becomes of a joint that loops move."""
    yield (
        f"joint {joint.name!r} is passive: the loops place it; it has no drive and needs no column"
        " in a log"
    )
    if joint.drive != DriveValues():
        yield f"friction and armature of passive joint {joint.name!r} are left out"


def _format_sum(factors: Mapping[str, float], offset: float) -> str:
    """Return `'elbow' (position x -1 +0.1)`, or a sum of such terms."""
    constant = f"{offset:+.6g}" if offset else ""
    if len(factors) == 1:
        name, factor = next(iter(factors.items()))
        return f"{name!r} (position x {factor:.6g}{constant})"
    return " ".join(f"{factor:+.6g} {name!r}" for name, factor in factors.items()) + (
        f" {constant}" if constant else ""
    )


def resolve_coupling(
    robot: str, joint: Joint, joints: Sequence[Joint], seen: tuple[str, ...] = ()
) -> tuple[dict[str, float], float]:
    """Return the factors by coordinate that move a joint in the end, and the offset.

    Raises `DescriptionError` where a source does not exist, or joints follow each other in a ring.
    """
    if joint.mimic is None or joint.is_passive:
        return {joint.name: 1.0}, 0.0
    if joint.name_in_tree in seen:
        # Following a chain of followers back to itself would not end.
        ring = " -> ".join(repr(name) for name in (*seen, joint.name_in_tree))
        raise DescriptionError(
            f"{robot}: joint {seen[0]!r} mimics itself{f' ({ring})' if len(seen) > 1 else ''}; name"
            " the joint it follows"
        )
    coordinates = {joint.name for joint in joints if joint.has_motor or joint.is_passive}
    others = {joint.name_in_tree: joint for joint in joints}
    found = dict[str, float]()
    offset = joint.mimic.offset
    for name, factor in joint.mimic.factors.items():
        if name in coordinates:
            part = {name: 1.0}
            more = 0.0
        elif name in others:
            part, more = resolve_coupling(robot, others[name], joints, (*seen, joint.name_in_tree))
        else:
            raise DescriptionError(
                f"{robot}: joint {joint.name_in_tree!r} mimics {name!r}, which does not exist;"
                f" the joints are {', '.join(dict.fromkeys((*others, *sorted(coordinates))))}",
                value=name,
                available=[*others],
            )
        # Offsets of sources pass on with their factor.
        offset += factor * more
        for source, share in part.items():
            # A coordinate may come in by several ways.
            found[source] = found.get(source, 0.0) + factor * share
    return found, offset


def derive_coupling(model: RobotParts) -> Coupling:
    """Return how the links of a robot move with its coordinates.

    Raises `DescriptionError` where some motion of the coordinates moves no link.
    """
    order, matrix, offset = derive_linear_part(model)
    names = model.joint_names
    if np.linalg.matrix_rank(matrix) < len(names):
        still = np.linalg.svd(matrix)[2][-1]
        held = sorted(name for name, share in zip(names, still, strict=True) if abs(share) > 1e-6)
        raise DescriptionError(
            f"{model.name}: the couplings are contradictory: some motion of {', '.join(held)} moves"
            " no link; every motor must move a joint in a way of its own"
        )
    for array in (order, matrix, offset):
        array.setflags(write=False)
    return Coupling(order, matrix, offset)


def derive_linear_part(model: RobotParts) -> tuple[Indices, Array, Array]:
    """Return order, matrix and offset of the joints of all links.

    The columns of the matrix are motors, then passive joints.
    """
    every = model.moving_joints
    coordinates = [*model.joints, *(joint for joint in model.followers if joint.is_passive)]
    names = {joint.name: k for k, joint in enumerate(coordinates)}
    order = np.array(model.link_order, dtype=np.int64)
    matrix = np.zeros((len(every), len(names)))
    offset = np.zeros(len(every))
    for i, link in enumerate(order.tolist()):
        factors, offset[i] = resolve_coupling(model.name, every[link], every)
        for name, factor in factors.items():
            matrix[i, names[name]] = factor
    return order, matrix, offset


def _take_over_drive(
    joint: Joint, follower: Joint, multiplier: float, offset: float
) -> tuple[Joint, list[str]]:
    """Return the driven joint with what its follower has of drive and limits."""
    notes = []
    values = {}
    for name, share in (
        # Reflected: inertia and damping by the square of the factor, dry friction by its size.
        ("armature", multiplier**2),
        ("viscous", multiplier**2),
        ("coulomb", abs(multiplier)),
        ("offset", multiplier),
    ):
        if value := getattr(follower.drive, name):
            values[name] = (getattr(joint.drive, name) or 0.0) + share * value
    if values:
        notes.append(f"{', '.join(values)} of joint {follower.name!r} count to {joint.name!r}")
    if follower.drive.terms or follower.drive.kp is not None:
        notes.append(f"further drive values of joint {follower.name!r} are left out")
    limits, further = _narrow_limits(joint, follower, multiplier, offset)
    return replace(joint, drive=replace(joint.drive, **values), limits=limits), [*notes, *further]


def _narrow_limits(
    joint: Joint, follower: Joint, multiplier: float, offset: float
) -> tuple[JointLimits, list[str]]:
    """Return the limits of a joint within its follower's, unless no motion would be left."""
    limits = joint.limits
    other = follower.limits
    if not multiplier:
        return limits, []
    # A negative factor turns the ends around.
    lower, upper = sorted((end - offset) / multiplier for end in (other.lower, other.upper))
    # Zero is no limit but an unknown one.
    rates = {
        name: min(getattr(limits, name), getattr(other, name) / abs(multiplier))
        for name in ("velocity", "acceleration", "jerk")
        if getattr(other, name) > 0.0
    }
    lower = max(limits.lower, lower)
    upper = min(limits.upper, upper)
    if not lower < upper:
        return replace(limits, **rates), [
            f"the position limits of joint {follower.name!r} leave {joint.name!r} no motion; they"
            " are left out"
        ]
    return replace(limits, lower=lower, upper=upper, **rates), []


def couple_joints(
    joints: Sequence[Joint],
    motors: Mapping[str, tuple[JointLimits, DriveValues]],
    moved: Mapping[str, Mimic],
) -> tuple[Joint, ...]:
    """Return joints that are moved as `moved` says by name, with a motor where they have one.

    Each motor is the coordinate of one joint that it moves; the first such in the order of the
    joints, so that motors without partner displace none. Raises `DescriptionError` where a joint or
    a motor does not exist, or moves no joint that another motor has not taken.
    """
    names = [joint.name for joint in joints]
    for name, mimic in moved.items():
        if name not in names:
            raise DescriptionError(
                f"a coupling moves joint {name!r}, which does not exist; the joints are"
                f" {', '.join(names)}"
            )
        if name in mimic.factors and name not in motors:
            raise DescriptionError(
                f"the coupling of joint {name!r} has it move with itself; name the motor that moves"
                " it, which needs [[motors]] if it is no joint"
            )
        for source in mimic.factors:
            if source not in names and source not in motors:
                raise DescriptionError(
                    f"the coupling of joint {name!r} names {source!r}, which is neither a joint nor"
                    f" one of the motors; motors are {', '.join(motors) or 'none'}, joints"
                    f" {', '.join(names)}; a motor that is no joint needs [[motors]] with its name"
                )
    free = [name for name in names if name in motors and name not in moved]
    if free:
        raise DescriptionError(
            f"motor {free[0]!r} has the name of a joint that no coupling moves; say how, or rename"
            " the motor"
        )
    at = _match_motors(motors, {name: moved[name] for name in names if name in moved})
    found = []
    for joint in joints:
        if joint.name not in moved:
            found.append(joint)
            continue
        mimic = moved[joint.name]
        if joint.name not in at:
            found.append(replace(joint, mimic=mimic))
            continue
        motor = at[joint.name]
        limits, drive = motors[motor]
        # The joint keeps its name in the tree where the motor has another.
        mimic = replace(mimic, joint=joint.name if motor != joint.name else "")
        found.append(replace(joint, name=motor, mimic=mimic, limits=limits, drive=drive))
    return tuple(found)


def _match_motors(motors: Mapping[str, object], moved: Mapping[str, Mimic]) -> dict[str, str]:
    """Return the motor of each joint that has one: a matching, found by augmenting paths."""
    at = dict[str, str]()

    def place(motor: str, tried: set[str]) -> bool:
        for joint, mimic in moved.items():
            # A factor of 0 moves nothing.
            if joint in tried or not mimic.factors.get(motor):
                continue
            tried.add(joint)
            # A joint that is taken is free again if its motor finds another one.
            if joint not in at or place(at[joint], tried):
                at[joint] = motor
                return True
        return False

    for motor in motors:
        if not place(motor, set()):
            raise DescriptionError(
                f"motor {motor!r} moves no joint of its own: every motor of {', '.join(motors)}"
                " must move a joint that no other one takes; name it in a coupling, or leave it out"
            )
    return at


def with_rotors(model: Robot, shares: Array) -> Robot:
    """Return a robot in which every coordinate is a joint of its own.

    A motor that is no joint gets a rotor without weight on the root, and the joint that had its
    coordinate follows, as other programs need it. `shares` (n, n) say how the far side of each
    drive turns with the coordinates.
    """
    joints = model.joints
    links = model.links
    moved = [k for k, joint in enumerate(joints) if joint.mimic is not None]
    if not moved:
        return model
    new = {k: len(links) + i for i, k in enumerate(moved)}
    # Bodies move behind all others; rotors take their places.
    place = {link: new.get(link, link) for link in range(len(links))} | {ROOT: ROOT}
    taken = {joint.name_in_tree for joint in model.moving_joints}
    behind = []
    for k in moved:
        mimic = joints[k].mimic
        name = joints[k].name_in_tree
        assert mimic is not None
        name = f"{name} joint" if name == joints[k].name else name
        # A name that nothing else in the tree has.
        while name in taken - {joints[k].name_in_tree}:
            name += "_"
        behind.append(
            replace(
                joints[k],
                name=name,
                parent=place[joints[k].parent],
                mimic=replace(mimic, joint=""),
                limits=JointLimits(),
                drive=DriveValues(),
            )
        )
    turning = np.where(np.any(shares, axis=1)[:, None], shares, np.eye(model.n_joints))
    return replace(
        model,
        joints=tuple(
            replace(joint, parent=ROOT, before=np.eye(4), after=np.eye(4), mimic=None)
            if k in new
            else replace(joint, parent=place[joint.parent])
            for k, joint in enumerate(joints)
        ),
        followers=(
            *(replace(joint, parent=place[joint.parent]) for joint in model.followers),
            *behind,
        ),
        links=(
            *(
                Link(f"rotor of {joints[k].name}", LinkInertia.zero(), negligible=True)
                if k in new
                else link
                for k, link in enumerate(links)
            ),
            *(links[k] for k in moved),
        ),
        frames=tuple(replace(frame, link=place[frame.link]) for frame in model.frames),
        motor_coupling=turning if shares.any() else None,
    )
