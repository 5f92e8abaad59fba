"""Robots with some joints held still: their bodies are merged as over fixed joints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.finite import LARGEST
from asbuilt.description.rotation import compose_placements
from asbuilt.description.structure.parts import ROOT, Frame, Joint, JointLimits, Link
from asbuilt.description.structure.robot import RobotParts
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Cure, Finding, join_names

Robot = TypeVar("Robot", bound=RobotParts)


def choose_usual_position(limits: JointLimits) -> float:
    """Return 0, or the middle of the limits [rad or m] if 0 lies outside them.

    >>> from asbuilt.description.model import JointLimits
    >>> choose_usual_position(JointLimits(0.01, 0.03))
    0.02
    >>> choose_usual_position(JointLimits(-1.0, 2.0))
    0.0
    """
    if limits.lower <= 0.0 <= limits.upper:
        return 0.0
    # Limits without 0 have at least one finite end.
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
        # NaN compares as false, and is refused with the rest.
        known = number is None or abs(number) <= LARGEST  # not of NaN
        if not name.strip() or not known or name.strip() in found:
            raise UsageError(
                "joints to lock are JOINT or JOINT=VALUE, each once, separated by commas, for"
                f" example finger=0.02, at most {LARGEST:g}; got {text!r}"
            )
        found[name.strip()] = number
    return found


def lock_joints(model: Robot, joints: Mapping[str, float | None] | Iterable[str]) -> Robot:
    """Return the robot with some joints held still, as `RobotModel.locked` says."""
    asked = dict(joints) if isinstance(joints, Mapping) else dict.fromkeys(joints)
    present, links, frames = model.in_tree_order()
    values, after, places = _derive_locked_positions(model, present, asked)
    if not values:
        return model
    kept, carriers, named = _merge_locked_links(after, links, frames, places)
    names = {link.name for link in carriers}
    return replace(
        model,
        joints=kept,
        links=carriers,
        frames=named,
        followers=(),
        posture={name: q for name, q in model.posture.items() if name not in values},
        motor_coupling=_drop_locked_motors(model, values),
        locked_joints={**model.locked_joints, **values},
        held_followers=_find_held_followers(present, model.held_followers, values),
        assumed_carriers=(
            *model.assumed_carriers,
            *_find_assumed_carriers(present, asked, values, places),
        ),
        usual_drive="",
        mass_ranges=tuple(known for known in model.mass_ranges if {*known.links} <= names),
    )


def _drop_locked_motors(model: RobotParts, values: Mapping[str, float]) -> Array | None:
    """Return the coupling of the motors that are not locked, None where each turns alone."""
    if model.motor_coupling is None:
        return None
    free = [k for k, name in enumerate(model.joint_names) if name not in values]
    coupling = model.motor_coupling[np.ix_(free, free)]
    if abs(np.linalg.det(coupling)) < 1e-9 and model.is_one_to_one:
        raise DescriptionError(
            f"{model.name}: with {', '.join(values)} locked, the coupled motors of the other"
            " joints do not turn with these alone; lock the joints coupled to them too"
        )
    return None if np.array_equal(coupling, np.eye(len(free))) else coupling


def _merge_locked_links(
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
                # Symbols of a placement hold for the place itself, not for one that was moved.
                free = replace(
                    free, before=compose_placements(at, joint.before), before_symbols=None
                )
            kept.append(free)
            carriers.append(link)
            carrier.append(len(kept) - 1)
            pose.append(np.eye(4))
            continue
        at = compose_placements(at, joint.before, joint.moved(values[joint.name]), joint.after)
        carrier.append(on)
        pose.append(at)
        named.append(Frame(link.name, on, at))
        if on != ROOT:
            # Bodies on the root carry nothing that moves, and vanish.
            carriers[on] = _join_parts(carriers[on], link, at)
    for frame in frames:
        if frame.link == ROOT:
            named.append(frame)
        else:
            place = compose_placements(pose[frame.link], frame.placement)
            named.append(replace(frame, link=carrier[frame.link], placement=place))
    return tuple(kept), tuple(carriers), tuple(named)


def _find_held_followers(
    present: Sequence[Joint], before: Mapping[str, str], values: Mapping[str, float]
) -> dict[str, str]:
    """Return the locked joints that follow one which stays, with that joint.

    `before` are those known already, `values` the joints that are locked now.
    """
    moving = {joint.name for joint in present} - values.keys()
    found = dict(before) | {
        joint.name: next((source for source in joint.mimic.factors if source in moving), "")
        for joint in present
        if joint.name in values and joint.mimic is not None and not joint.has_motor
    }
    return {name: source for name, source in found.items() if source in moving}


def _find_assumed_carriers(
    present: Sequence[Joint],
    asked: Mapping[str, float | None],
    values: Mapping[str, float],
    places: Mapping[str, float],
) -> tuple[str, ...]:
    """Return the locked joints on which the pose of a moving one depends, and that nobody gave.

    They carry it, or move it with others. `asked` are the positions that were given, `values` those
    locked now, `places` where joints stand that are held. The weight of all that a joint carries
    turns with its position: at 0 it is a guess.
    """
    carry: set[str] = set()
    # All that lies between a moving joint and the root turns its weight.
    for i, joint in enumerate(present):
        above = ROOT if joint.name in places else i
        while above != ROOT:
            moved = present[above].mimic
            carry |= {present[above].name, *(moved.factors if moved is not None else ())}
            above = present[above].parent
    guessed = [
        joint.name
        for joint in present
        if joint.name in values and asked.get(joint.name) is None and joint.has_motor
    ]
    return tuple(name for name in guessed if name in carry)


def report_locks(model: RobotParts) -> Iterator[Finding]:
    """Yield a finding that names the locked joints with their positions.

    It is a warning where some of them carry joints that move, at positions that are assumed.
    Another one names those that follow a joint which moves.
    """
    held = [f"{name} at {value:.4g}" for name, value in model.locked_joints.items()]
    carriers = model.assumed_carriers
    guess = (
        f"; {join_names(carriers)} carr{'y' if len(carriers) > 1 else 'ies'} joints that move, so"
        " that their torques are wrong if this position is"
        if carriers
        else ""
    )
    several = len(held) > 1
    if held:
        yield Finding(
            "joints_locked",
            "warning" if carriers else "info",
            f"joints are locked that the recording lacks or that were named: {join_names(held)};"
            f" their links count to those that carry them{guess}"
            if several
            else f"joint {held[0]} is locked, since the recording lacks it or it was named; its"
            f" link counts to the one that carries it{guess}",
            Cure(
                f"if {'they' if several else 'it'} stood elsewhere, give the"
                f" position{'s' if several else ''}",
                {"lock": ",".join(f"{name}=VALUE" for name in model.locked_joints)},
            ),
        )
    if model.held_followers:
        coupled = [f"{name} follows {source}" for name, source in model.held_followers.items()]
        yield Finding(
            "follower_held",
            "warning",
            f"{join_names(coupled)}, but is held still: the inertia, weight and friction of what it"
            " moves are missing from the torque of the joint that it follows",
            Cure("do not trust that joint's parameters, or record with it at rest and lock it"),
        )


def _derive_locked_positions(
    model: RobotParts,
    present: Sequence[Joint],
    asked: Mapping[str, float | None],
) -> tuple[dict[str, float], tuple[Joint, ...], dict[str, float]]:
    """Return the positions of all that is locked, the joints then, and where those held stand.

    A joint is held if what moves it is locked, all of it; a joint of which a part is locked follows
    the rest.
    """
    robot = model.name
    locked = model.locked_joints
    by_name = {joint.name: joint for joint in present}
    unknown = next((name for name in asked if name not in by_name and name not in locked), None)
    placed = next((name for name in asked if name in by_name and by_name[name].is_passive), None)
    if unknown is not None:
        raise DescriptionError(
            f"{robot} has no joint {unknown!r} to lock; its joints are"
            f" {', '.join((*by_name, *locked))}",
            value=unknown,
            available=[*by_name, *locked],
        )
    if placed is not None:
        raise DescriptionError(
            f"joint {placed!r} cannot be locked: the loops of {robot} place it; lock the motors"
            " that move it",
            value=placed,
        )
    for name, value in asked.items():
        if value is not None and not math.isfinite(value):
            raise DescriptionError(f"joint {name!r} cannot be locked at {value}; give a number")
        there = locked.get(name)
        if name not in by_name and value is not None and there is not None and value != there:
            # Locking again at the same place is allowed, so that calls can repeat.
            raise DescriptionError(f"joint {name!r} is locked at {there:g} already, not at {value}")
    lock = _Lock(by_name, locked, asked)
    values = {name: lock.value(name) for name in by_name if name in lock.held}
    after = tuple(lock.joint(joint) for joint in present)
    places = {joint.name: lock.place(joint) for joint in after if lock.is_held(joint)}
    # A robot without a free motor has nothing to identify.
    if all(joint.name in values or not joint.has_motor for joint in present):
        raise DescriptionError(f"{robot}: all joints are locked; leave at least one free")
    return values, after, places


class _Lock:
    """Find what is held where some joints are locked, and where it stands."""

    def __init__(
        self,
        by_name: Mapping[str, Joint],
        locked: Mapping[str, float],
        asked: Mapping[str, float | None],
    ) -> None:
        self._by_name = {joint.name_in_tree: joint for joint in by_name.values()} | dict(by_name)
        self._locked = locked
        self._asked = asked
        self.held = {name for name in asked if name in by_name}
        # Holding one joint may hold others, until none is added.
        while (
            more := {
                joint.name
                for joint in by_name.values()
                if joint.mimic is not None
                and not joint.has_motor
                and not joint.is_passive
                and all(self._is_still(name) for name in joint.mimic.factors)
            }
            - self.held
        ):
            self.held |= more

    def _is_still(self, source: str) -> bool:
        joint = self._by_name.get(source)
        if joint is None or source == joint.name:
            return joint is None or source in self.held
        return self.is_held(joint)

    def is_held(self, joint: Joint) -> bool:
        """Whether the joint itself stands still, with all that moves it."""
        if joint.mimic is None or not joint.has_motor:
            return joint.name in self.held
        return all(self._is_still(name) for name in joint.mimic.factors)

    def value(self, name: str) -> float:
        """Return the position of a coordinate, or of a joint that follows."""
        if name in self._locked:
            return self._locked[name]
        joint = self._by_name[name]
        value = self._asked.get(name)
        if name == joint.name and value is not None:
            return float(value)
        if joint.mimic is None or (joint.has_motor and name == joint.name):
            return choose_usual_position(joint.limits)
        return self.place(joint)

    def place(self, joint: Joint) -> float:
        """Return the position of a joint itself from the positions that move it."""
        if joint.mimic is None or (self._asked.get(joint.name) is not None and not joint.has_motor):
            return self.value(joint.name)
        moved = (factor * self.value(name) for name, factor in joint.mimic.factors.items())
        return sum(moved) + joint.mimic.offset

    def joint(self, joint: Joint) -> Joint:
        """Return a joint with what is locked among its sources in its offset."""
        if joint.mimic is None or self.is_held(joint):
            return joint
        still = [name for name in joint.mimic.factors if self._is_still(name)]
        # A joint that was given a place of its own stands there, whatever it follows.
        if not still:
            return joint
        factors = {name: f for name, f in joint.mimic.factors.items() if name not in still}
        offset = joint.mimic.offset + sum(
            joint.mimic.factors[name] * self.value(name) for name in still
        )
        # With its own motor locked it is no coordinate any more, and has its name in the tree.
        name = joint.name if joint.name in factors else joint.name_in_tree
        return replace(joint, name=name, mimic=replace(joint.mimic, factors=factors, offset=offset))


def _join_parts(carrier: Link, link: Link, pose: Array) -> Link:
    """Return a link to which another is fixed, both with the names of their parts."""
    if not link.inertia_known:
        # A link without known inertia adds nothing that could be told apart later.
        return carrier
    known_parts = carrier.parts or (
        ((carrier.name, carrier.inertia),) if carrier.inertia_known else ()
    )
    more = link.parts or ((link.name, link.inertia),)
    parts = (*known_parts, *((name, inertia.moved(pose)) for name, inertia in more))
    return replace(Link.of_parts(carrier.name, parts), negligible=carrier.negligible)
