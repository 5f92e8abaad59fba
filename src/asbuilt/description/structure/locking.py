"""Robots with some joints held still: their bodies are merged as over fixed joints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.rotation import composed, placement, rotation_z
from asbuilt.description.structure.parts import ROOT, Frame, Joint, JointLimits, Link
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Cure, Finding, joined


def usual_position(limits: JointLimits) -> float:
    """Return 0, or the middle of the limits [rad or m] if 0 lies outside them.

    >>> from asbuilt.description.model import JointLimits
    >>> usual_position(JointLimits(0.01, 0.03)), usual_position(JointLimits(-1.0, 2.0))
    (0.02, 0.0)
    """
    if limits.lower <= 0.0 <= limits.upper:
        return 0.0
    ends = [end for end in (limits.lower, limits.upper) if math.isfinite(end)]
    return sum(ends) / len(ends)


def locks_from_text(text: str) -> dict[str, float | None]:
    """Return the joints of `JOINT[=VALUE],...` with their positions [rad or m], None if not given.

    Raises `UsageError` for any other text.

    >>> locks_from_text("left=0.02,right")
    {'left': 0.02, 'right': None}
    """
    found: dict[str, float | None] = {}
    for part in text.split(","):
        name, given, value = part.partition("=")
        try:
            number = float(value) if given else None
        except ValueError:
            number = math.nan
        if not name.strip() or (number is not None and not math.isfinite(number)):
            raise UsageError(
                "joints to lock are JOINT or JOINT=VALUE, separated by commas, for example"
                f" finger=0.02; got {text!r}"
            )
        found[name.strip()] = number
    return found


def merged(
    joints: Sequence[Joint],
    links: Sequence[Link],
    frames: Sequence[Frame],
    values: Mapping[str, float],
) -> tuple[tuple[Joint, ...], tuple[Link, ...], tuple[Frame, ...]]:
    """Return joints, links and frames of a robot whose joints of `values` are fixed there."""
    kept: list[Joint] = []
    carriers: list[Link] = []
    carrier: list[int] = []
    pose: list[Array] = []
    named: list[Frame] = []
    for joint, link in zip(joints, links, strict=True):
        on, at = (
            (ROOT, np.eye(4))
            if joint.parent == ROOT
            else (carrier[joint.parent], pose[joint.parent])
        )
        if joint.name not in values:
            free = replace(joint, parent=on)
            if not np.array_equal(at, np.eye(4)):
                free = replace(free, before=composed(at, joint.before), before_symbols=None)
            kept.append(free)
            carriers.append(link)
            carrier.append(len(kept) - 1)
            pose.append(np.eye(4))
            continue
        at = composed(at, joint.before, _motion(joint, values[joint.name]), joint.after)
        carrier.append(on)
        pose.append(at)
        named.append(Frame(link.name, on, at))
        if on != ROOT:
            carriers[on] = _with_parts(carriers[on], link, at)
    for frame in frames:
        if frame.link == ROOT:
            named.append(frame)
        else:
            place = composed(pose[frame.link], frame.placement)
            named.append(replace(frame, link=carrier[frame.link], placement=place))
    return tuple(kept), tuple(carriers), tuple(named)


def held_followers(
    present: Sequence[Joint], before: Mapping[str, str], values: Mapping[str, float]
) -> dict[str, str]:
    """Return the locked joints that follow one which stays, with that joint.

    `before` are those known already, `values` the joints that are locked now.
    """
    found = dict(before) | {
        joint.name: joint.mimic.joint
        for joint in present
        if joint.name in values and joint.mimic is not None
    }
    moving = {joint.name for joint in present} - values.keys()
    return {name: of for name, of in found.items() if of in moving}


def assumed_carriers(
    present: Sequence[Joint],
    before: Sequence[str],
    joints: Mapping[str, float | None] | Iterable[str],
    values: Mapping[str, float],
) -> tuple[str, ...]:
    """Return the locked joints that carry one which moves, and whose position nobody gave.

    `before` are those known already, `joints` the ones asked for, `values` those locked now. The
    weight of all that a joint carries turns with its position: at 0 it is a guess.
    """
    given = joints if isinstance(joints, Mapping) else {}
    carry: set[str] = set()
    for joint in present:
        parent = ROOT if joint.name in values else joint.parent
        while parent != ROOT:
            carry.add(present[parent].name)
            parent = present[parent].parent
    guessed = [
        joint.name
        for joint in present
        if joint.name in values and given.get(joint.name) is None and joint.mimic is None
    ]
    return (*before, *(name for name in guessed if name in carry))


def lock_findings(
    locked: Mapping[str, float],
    followers: Mapping[str, str] | None = None,
    carriers: Sequence[str] = (),
) -> tuple[Finding, ...]:
    """Return a finding that names the locked joints with their positions.

    It is a warning where some of them (`carriers`) carry joints that move, at positions that are
    assumed. Another one names those that follow (`followers`) a joint which moves.
    """
    if not locked:
        return ()
    coupled = [f"{name} follows {of}" for name, of in (followers or {}).items()]
    held_still = (
        Finding(
            "follower_held",
            "warning",
            f"{joined(coupled)}, but is held still: the inertia, weight and friction of what it"
            " moves are missing from the torque of the joint that it follows",
            Cure("do not trust that joint's parameters, or record with it at rest and lock it"),
        ),
    )
    held = [f"{name} at {value:.4g}" for name, value in locked.items()]
    names = ",".join(f"{name}=VALUE" for name in locked)
    several = len(held) > 1
    guess = (
        f"; {joined(carriers)} carr{'y' if len(carriers) > 1 else 'ies'} joints that move, so that"
        " their torques are wrong if this position is"
        if carriers
        else ""
    )
    return (
        Finding(
            "joints_locked",
            "warning" if carriers else "info",
            f"joints are locked that the recording lacks or that were named: {joined(held)}; their"
            f" links count to those that carry them{guess}"
            if several
            else f"joint {held[0]} is locked, since the recording lacks it or it was named; its"
            f" link counts to the one that carries it{guess}",
            Cure(
                f"if {'they' if several else 'it'} stood elsewhere, give the"
                f" position{'s' if several else ''}",
                {"lock": names},
            ),
        ),
        *(held_still if coupled else ()),
    )


def locked_positions(
    robot: str,
    present: Sequence[Joint],
    locked: Mapping[str, float],
    joints: Mapping[str, float | None] | Iterable[str],
) -> dict[str, float]:
    """Return the position of every joint to lock, those that mimic a locked one included."""
    asked = dict(joints) if isinstance(joints, Mapping) else dict.fromkeys(joints)
    by_name = {joint.name: joint for joint in present}
    unknown = [name for name in asked if name not in by_name and name not in locked]
    if unknown:
        raise DescriptionError(
            f"{robot} has no joint {unknown[0]!r} to lock; its joints are"
            f" {', '.join((*by_name, *locked))}",
            value=unknown[0],
            available=[*by_name, *locked],
        )
    for name, value in asked.items():
        if value is not None and not math.isfinite(value):
            raise DescriptionError(f"joint {name!r} cannot be locked at {value}; give a number")
        there = locked.get(name)
        if name not in by_name and value is not None and there is not None and value != there:
            raise DescriptionError(f"joint {name!r} is locked at {there:g} already, not at {value}")
    found: dict[str, float] = {}

    def position(name: str) -> float:
        """Return where a joint stands, of a mimic joint by what it follows."""
        if name in locked:
            return locked[name]
        if name not in found:
            joint, value = by_name[name], asked.get(name)
            found[name] = usual_position(joint.limits)
            if value is not None:
                found[name] = float(value)
            elif joint.mimic is not None:
                master = joint.mimic
                found[name] = master.multiplier * position(master.joint) + master.offset
        return found[name]

    held = {name for name in asked if name in by_name}
    followers = {joint.name: joint.mimic.joint for joint in present if joint.mimic is not None}
    while more := {name for name, of in followers.items() if of in held} - held:
        held |= more
    if held == by_name.keys():
        raise DescriptionError(f"{robot}: all joints are locked; leave at least one free")
    return {joint.name: position(joint.name) for joint in present if joint.name in held}


def _motion(joint: Joint, value: float) -> Array:
    if joint.is_revolute:
        return placement(rotation_z(value))
    return placement(translation=(0.0, 0.0, value))


def _with_parts(carrier: Link, link: Link, pose: Array) -> Link:
    """Return a link to which another is fixed, both with the names of their parts."""
    if not link.inertia_known:
        return carrier
    own = carrier.parts or (((carrier.name, carrier.inertia),) if carrier.inertia_known else ())
    more = link.parts or ((link.name, link.inertia),)
    parts = (*own, *((name, inertia.moved(pose)) for name, inertia in more))
    total = LinkInertia(np.sum([inertia.parameters for _, inertia in parts], axis=0))
    return replace(carrier, inertia=total, inertia_known=True, parts=parts)
