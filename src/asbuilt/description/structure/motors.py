"""Motors that are no joints: which of the coupled joints has the coordinate of which motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.structure.parts import (
    ROOT,
    DriveValues,
    Frame,
    Joint,
    JointLimits,
    Link,
    Mimic,
)
from asbuilt.errors import DescriptionError


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


def with_rotors(
    joints: Sequence[Joint],
    followers: Sequence[Joint],
    links: Sequence[Link],
    frames: Sequence[Frame],
) -> tuple[tuple[Joint, ...], tuple[Joint, ...], tuple[Link, ...], tuple[Frame, ...]]:
    """Return parts of a robot in which every coordinate is a joint of its own.

    A motor that is no joint gets a rotor without weight on the root, and the joint that had its
    coordinate follows, as other programs need it.
    """
    moved = [k for k, joint in enumerate(joints) if joint.mimic is not None]
    new = {k: len(links) + i for i, k in enumerate(moved)}
    # Bodies move behind all others; rotors take their places.
    place = {link: new.get(link, link) for link in range(len(links))} | {ROOT: ROOT}
    taken = {joint.name_in_tree for joint in (*joints, *followers)}
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
    return (
        tuple(
            replace(joint, parent=ROOT, before=np.eye(4), after=np.eye(4), mimic=None)
            if k in new
            else replace(joint, parent=place[joint.parent])
            for k, joint in enumerate(joints)
        ),
        (*(replace(joint, parent=place[joint.parent]) for joint in followers), *behind),
        (
            *(
                Link(f"rotor of {joints[k].name}", LinkInertia.zero(), negligible=True)
                if k in new
                else link
                for k, link in enumerate(links)
            ),
            *(links[k] for k in moved),
        ),
        tuple(replace(frame, link=place[frame.link]) for frame in frames),
    )
