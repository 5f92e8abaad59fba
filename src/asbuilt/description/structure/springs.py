"""Springs and cylinders between two links, as terms of the drive of the joint between them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.structure.parts import ROOT, Joint
from asbuilt.errors import DescriptionError

if TYPE_CHECKING:
    from asbuilt.description.model import RobotModel

SpringKind = Literal["extension", "cylinder", "torsion"]
TERM_OF_KIND: Mapping[str, str] = {
    "extension": "extension_spring",
    "cylinder": "cylinder",
    "torsion": "spring",
}
"""Drive term of each kind."""
ON_AXIS = 1e-4
"""Distance [m] from the joint axis below which an end counts as on it."""


@dataclass(frozen=True, eq=False)
class Spring:
    """Say where a spring or a cylinder acts, and what is known of its force.

    An `extension` spring pulls two points together with `stiffness (l - free_length)`, one
    without free length as an ideal balancer does, with the torque of a weight; a `cylinder`
    pushes them apart with `force (1 + progression (free_length - l))`, l being their distance
    [m]; a `torsion` spring turns `joint` back to `rest` [rad or m]. `point_a`, `point_b` (3,) are
    in the axes of the links or frames `link_a`, `link_b` [m]. `stiffness` [N/m, N m/rad] and
    `force` [N] are None where they are to be identified.
    """

    kind: SpringKind = "extension"
    link_a: str = ""
    point_a: Array = field(default_factory=lambda: np.zeros(3))
    link_b: str = ""
    point_b: Array = field(default_factory=lambda: np.zeros(3))
    free_length: float = 0.0
    joint: str = ""
    rest: float = 0.0
    stiffness: float | None = None
    force: float | None = None
    progression: float = 0.0
    name: str = ""

    def __str__(self) -> str:
        ends = f"between {self.link_a} and {self.link_b}" if self.link_a else f"at {self.joint}"
        return f"the {self.kind} spring {self.name!r}" if self.name else f"the spring {ends}"

    @property
    def known(self) -> dict[str, float]:
        """What is known of its force, by the symbols of its drive term."""
        by_symbol = {
            "extension": {"Ke": self.stiffness},
            "cylinder": {"Pc": self.force},
            "torsion": {"Ks": self.stiffness},
        }[self.kind]
        return {symbol: value for symbol, value in by_symbol.items() if value is not None}


def with_springs(model: RobotModel, springs: Sequence[Spring]) -> RobotModel:
    """Return a robot whose drives have the terms of springs and cylinders.

    Springs of one kind and geometry at one joint are one, with the sum of their forces.

    Raises
    ------
    DescriptionError
        If a link or joint does not exist, if both ends are on one link or several joints are
        between them, or if a joint has springs of one kind that differ.
    """
    terms = [dict(joint.drive.terms) for joint in model.joints]
    for spring in springs:
        k, numbers = (_place_torsion_spring if spring.kind == "torsion" else _place_linear_spring)(
            model, spring
        )
        key = TERM_OF_KIND[spring.kind]
        values = {**numbers, **spring.known}
        # Without free length the force is linear in the length: a balancer's torque.
        if key == "extension_spring" and not spring.free_length:
            key = "balancer"
            values = _convert_to_balancer(values)
        there = terms[k].get(key)
        terms[k][key] = (
            values if there is None else _combine_springs(spring, model, k, there, values)
        )
    joints = tuple(
        replace(joint, drive=replace(joint.drive, terms=joint_terms))
        for joint, joint_terms in zip(model.joints, terms, strict=True)
    )
    return replace(model, joints=joints)


def _place_torsion_spring(model: RobotModel, spring: Spring) -> tuple[int, dict[str, float]]:
    """Return the joint of a torsion spring, and where it is at rest."""
    if spring.joint not in model.joint_names:
        raise DescriptionError(
            f"{spring} names joint {spring.joint!r}; joints with a drive are"
            f" {', '.join(model.joint_names)}",
            value=spring.joint,
            available=model.joint_names,
        )
    return model.joint_names.index(spring.joint), {"rest": spring.rest}


def _place_linear_spring(model: RobotModel, spring: Spring) -> tuple[int, dict[str, float]]:
    """Return the joint between the ends of a spring, and their places about its axis."""
    (one, at_one), (other, at_other) = (
        _place_point(model, spring, link, point)
        for link, point in ((spring.link_a, spring.point_a), (spring.link_b, spring.point_b))
    )
    if one == other:
        raise DescriptionError(
            f"both ends of {spring} are on {_name_link(model, one)}, {spring.point_a.tolist()} and"
            f" {spring.point_b.tolist()}, so that no joint moves one against the other"
        )
    # The parent first, so that the joint between is the second one's.
    if one != ROOT and model.parents[one] == other:
        one, at_one, other, at_other = other, at_other, one, at_one
    if other == ROOT or model.parents[other] != one:
        raise DescriptionError(
            f"{spring} spans more than one joint, between {_name_link(model, one)} and"
            f" {_name_link(model, other)}; only springs between a link and the one that carries"
            " it are described"
        )
    joint = model.moving_joints[other]
    # A joint that follows has no drive to carry the term.
    if other >= model.n_joints or joint.mimic is not None:
        raise DescriptionError(
            f"{spring} is at joint {joint.name_in_tree!r}, which has no motor of its own; describe"
            " the spring at a joint that one moves alone"
        )
    if not joint.is_revolute:
        raise DescriptionError(
            f'{spring} is at joint {joint.name!r}, which slides; give kind = "torsion" with the'
            " position at which the spring is at rest"
        )
    return other, _measure_about_axis(spring, joint, at_one, at_other)


def _place_point(model: RobotModel, spring: Spring, link: str, point: Array) -> tuple[int, Array]:
    try:
        return model.place_of(link, point)
    except DescriptionError as error:
        raise DescriptionError(f"{spring}: {error}", value=link) from None


def _name_link(model: RobotModel, link: int) -> str:
    return repr(model.root_link if link == ROOT else model.link_names[link])


def _measure_about_axis(
    spring: Spring, joint: Joint, below: Array, above: Array
) -> dict[str, float]:
    """Return distances of both ends from the joint axis, along it, and the angle between them.

    `below` (3,) is in the axes of the parent link, `above` (3,) in the axes of the joint's link.
    """
    R = joint.before[:3, :3]
    p = joint.before[:3, 3]
    # In the axes at the joint, which turns about their z.
    at_rest = R.T @ (below - p)
    turning = joint.after[:3, :3] @ above + joint.after[:3, 3]
    inner, outer = (float(math.hypot(*end[:2])) for end in (at_rest, turning))
    axial = float(abs(turning[2] - at_rest[2]))
    angle = math.atan2(turning[1], turning[0]) - math.atan2(at_rest[1], at_rest[0])
    # The position at which both ends lie in one direction from the axis.
    meets = math.remainder(-angle, 2.0 * math.pi)
    low = joint.limits.lower
    high = joint.limits.upper
    # Within the limits it may be met a turn earlier or later.
    reached = [meets + turn for turn in (-2.0 * math.pi, 0.0, 2.0 * math.pi)]
    if min(inner, outer) < ON_AXIS:
        raise DescriptionError(
            f"an end of {spring} is on the axis of joint {joint.name!r}, {min(inner, outer):.3g} m"
            " from it, where it has no torque; check point_a and point_b"
        )
    # Equal distances and heights: there the ends meet, and the force has no direction.
    if math.hypot(inner - outer, axial) < ON_AXIS and any(low <= q <= high for q in reached):
        raise DescriptionError(
            f"the ends of {spring} coincide at position {meets:.3f} of joint {joint.name!r}, within"
            " its limits; there the spring has no direction: check point_a and point_b"
        )
    rate = {"rate": spring.progression} if spring.kind == "cylinder" else {}
    return rate | {
        "inner": inner,
        "outer": outer,
        "angle": math.remainder(angle, 2.0 * math.pi),
        "axial": axial,
        "length": spring.free_length,
    }


def _convert_to_balancer(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return `Ke inner outer sin(q + angle)`, the torque without free length, as a balancer's."""
    # Ke inner outer sin(q + angle) = Bs sin q + Bc cos q
    size = numbers.get("Ke", math.nan) * numbers["inner"] * numbers["outer"]
    parts = {"Bs": size * math.cos(numbers["angle"]), "Bc": size * math.sin(numbers["angle"])}
    # An unknown stiffness leaves the balancer to be identified.
    return parts if "Ke" in numbers else {}


def _combine_springs(
    spring: Spring,
    model: RobotModel,
    k: int,
    there: Mapping[str, float],
    values: Mapping[str, float],
) -> dict[str, float]:
    """Return the numbers of two springs of one geometry together."""
    # Forces add up; lengths must agree.
    known = {*spring.known, "Bs", "Bc"}
    alike = set(there) == set(values) and all(
        math.isclose(there[name], values[name], rel_tol=1e-9, abs_tol=1e-9)
        for name in values.keys() - known
    )
    if not alike:
        raise DescriptionError(
            f"{spring} is the second {spring.kind} spring at joint {model.joint_names[k]!r}, with"
            " other lengths than the first, or known in part only; one geometry a joint and kind is"
            " described"
        )
    return {name: x + (there[name] if name in known else 0.0) for name, x in values.items()}


def spring_ends(joint: Joint, numbers: Mapping[str, float]) -> tuple[Array, Array]:
    """Return ends (3,) of a spring that has these numbers, in the axes of parent and link.

    About the axis they may be elsewhere than the described ones; the torque is the same.
    """
    at_rest = numbers["inner"] * np.array(
        # Any angle about the axis that keeps the difference gives the same torque.
        [math.cos(numbers["angle"]), -math.sin(numbers["angle"]), 0.0]
    )
    turning = np.array([numbers["outer"], 0.0, numbers.get("axial", 0.0)])
    below = joint.before[:3, :3] @ at_rest + joint.before[:3, 3]
    return below, joint.after[:3, :3].T @ (turning - joint.after[:3, 3])
