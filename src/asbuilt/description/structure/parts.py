"""Parts of a robot: joints with their limits and drives, links, frames and kinematic arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.codec import store_as
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.rotation import check_placement, placement, rotation_z
from asbuilt.errors import DescriptionError, UsageError

JointKind = Literal["revolute", "continuous", "prismatic"]
BaseKind = Literal["fixed", "free", "planar"]
"""How the base of a robot can move."""
Symbols = tuple[tuple[tuple[float, str], ...], ...]
"""A translation with symbols for lengths: for x, y and z a sum of (factor, symbol), e.g.

`(((1.0, "a2"),), (), ((1.0, "b2"),))`.
"""

USUAL_GRAVITY = (0.0, 0.0, -9.81)
"""Acceleration of free fall [m/s^2] where a description does not say.

What other programs take, z pointing up.
"""
PLAIN_TERMS = ("armature", "viscous", "coulomb", "offset")
"""Drive terms that a description states by themselves; all others are further terms."""
ROOT = -1
"""Parent index of a joint that hangs on the root link."""
UNLIMITED = store_as(missing=np.inf)
"""How an upper limit is stored that may be infinite."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of one joint: rad or m for position and its derivatives, N m or N for torque.

    Infinite where unknown.

    Raises `DescriptionError` where they leave no position, or a limit is negative or not a number.
    """

    lower: float = field(default=-np.inf, metadata=store_as(missing=-np.inf))
    upper: float = field(default=np.inf, metadata=UNLIMITED)
    velocity: float = field(default=np.inf, metadata=UNLIMITED)
    acceleration: float = field(default=np.inf, metadata=UNLIMITED)
    jerk: float = field(default=np.inf, metadata=UNLIMITED)
    torque: float = field(default=np.inf, metadata=UNLIMITED)

    def __post_init__(self) -> None:
        # NaN fails every comparison, and is refused as well.
        if not self.lower <= self.upper or self.lower == np.inf or self.upper == -np.inf:
            raise DescriptionError(
                f"position limits from {self.lower} to {self.upper} leave no position; give the"
                " lower one first"
            )
        for name in ("velocity", "acceleration", "jerk", "torque"):
            if not getattr(self, name) >= 0.0:
                raise DescriptionError(
                    f"the {name} limit of a joint is {getattr(self, name)}; it must not be"
                    " negative, and infinite where unknown"
                )


@dataclass(frozen=True, slots=True)
class MassRange:
    """What is known of the mass of links together [kg], such as from a scale.

    Raises `DescriptionError` if no positive mass lies strictly between `lower` and `upper`.
    """

    links: tuple[str, ...]
    lower: float = 0.0
    upper: float = np.inf

    def __post_init__(self) -> None:
        if not self.links or not 0.0 <= self.lower < self.upper:
            raise DescriptionError(
                f"the mass of {', '.join(self.links) or 'no link'} is given between"
                f" {self.lower:g} and {self.upper:g} kg; expected a link, and a lower limit of at"
                " least 0 below the upper one"
            )


@dataclass(frozen=True, slots=True)
class DriveValues:
    """What the description says of one drive.

    Armature [kg m^2], viscous [N m s/rad], Coulomb [N m], offset [N m]; None where silent.

    All are on the joint's side; `gear_ratio` is how many turns of the motor make one of the joint
    (rad per m where it slides), and takes them to the motor's. `terms` are further terms of the
    drive by key, each with its parameters by symbol and its nonlinear parameters by name:
    `{"stribeck": {"Fs": 0.3, "velocity": 0.05, "power": 2.0}}`. `kp` [N m/rad] and `kd`
    [N m s/rad] are the gains of a position servo, whose torque limit is the joint's.
    """

    armature: float | None = None
    viscous: float | None = None
    coulomb: float | None = None
    offset: float | None = None
    gear_ratio: float | None = None
    kp: float | None = None
    kd: float | None = None
    terms: Mapping[str, Mapping[str, float]] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class Mimic:
    """Say how others move a joint: its position is `sum_j factors[j] position_j + offset`.

    `factors` are by the names of motors (columns of a log) or of other joints. A joint whose
    `factors` name itself has a motor of its own, one whose do not follows the others. `joint` is
    the joint's own name where its motor has another.
    """

    factors: Mapping[str, float] = field(hash=False)
    offset: float = 0.0
    joint: str = ""

    @classmethod
    def of(cls, joint: str, other: str, multiplier: float, offset: float) -> Mimic:
        """Return how a joint follows another; raises `DescriptionError` where it is no other."""
        if joint == other:
            # By its own name a joint names its motor, which it then would have.
            raise DescriptionError(f"joint {joint!r} mimics itself; name the joint it follows")
        return cls({other: multiplier}, offset)

    def __str__(self) -> str:
        terms = [f"{factor:+.6g} {name}" for name, factor in self.factors.items()]
        terms += [f"{self.offset:+.6g}"] if self.offset else []
        return " ".join(terms).removeprefix("+")


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Connect a parent link to the link of the same index.

    The pose of the link in its parent link is `before @ motion(q) @ after`, 4 x 4 matrices [m]; the
    motion is a rotation about z or a translation along z. `mimic` says how motors and other joints
    move this one, None if a motor of its own and of its name does, one to one. Raises
    `DescriptionError` for another kind, and for matrices that are no placements.
    """

    name: str
    kind: JointKind
    parent: int
    before: Array
    after: Array
    limits: JointLimits = JointLimits()
    drive: DriveValues = DriveValues()
    before_symbols: Symbols | None = None
    after_symbols: Symbols | None = None
    mimic: Mimic | None = None

    def __post_init__(self) -> None:
        kinds = get_args(JointKind)
        if self.kind not in kinds:
            raise DescriptionError(
                f"joint {self.name!r} is {self.kind!r}; known kinds: {', '.join(kinds)}"
            )
        object.__setattr__(
            self,
            "before",
            check_placement(self.before, f"the placement before joint {self.name!r}"),
        )
        object.__setattr__(
            self, "after", check_placement(self.after, f"the placement after joint {self.name!r}")
        )

    def __repr__(self) -> str:
        return f"Joint({self.name!r}, {self.kind!r}, parent={self.parent})"

    @property
    def has_motor(self) -> bool:
        """Whether a motor of its own, which has its name, moves it, alone or with others."""
        # A motor's own factor is by the joint's name.
        return self.mimic is None or self.name in self.mimic.factors

    @property
    def is_passive(self) -> bool:
        """Whether neither a motor nor another joint but loops of the robot place it."""
        return self.mimic is not None and not self.mimic.factors

    @property
    def name_in_tree(self) -> str:
        """Name of the joint itself, where its motor has another name."""
        return self.name if self.mimic is None else self.mimic.joint or self.name

    def moved(self, position: float) -> Array:
        """Return the motion (4, 4) at a position [rad or m]."""
        if self.is_revolute:
            return placement(rotation_z(position))
        return placement(translation=(0.0, 0.0, position))

    @property
    def is_revolute(self) -> bool:
        """Whether the joint turns (also without end) rather than slides."""
        return self.kind != "prismatic"

    @property
    def unit(self) -> str:
        """Unit of its position: rad or m."""
        return "rad" if self.is_revolute else "m"

    @property
    def torque_unit(self) -> str:
        """Unit of its torque, or force: N m or N."""
        return "N m" if self.is_revolute else "N"


def ancestors(joints: Sequence[Joint], link: int) -> list[int]:
    """Return the links from the root to a link, itself included, by the joints that move them."""
    chain: list[int] = []
    while link != ROOT:
        chain.append(link)
        # By parents from the link up, then turned round.
        link = joints[link].parent
    return chain[::-1]


def _list_numbers(body: LinkInertia) -> Any:
    return body.parameters.tolist()


def _read_body(numbers: Sequence[float]) -> LinkInertia:
    return LinkInertia(np.array(numbers, dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """One moving rigid body.

    `inertia` is the sum of its `parts`, which remember bodies merged over fixed joints.

    `inertia_known` is False where the description gave none and zeros stand in. A `negligible`
    link is declared to have an inertia too small to matter: none of its parameters is estimated.
    """

    name: str
    inertia: LinkInertia = field(metadata=store_as(encode=_list_numbers, decode=_read_body))
    inertia_known: bool = True
    parts: tuple[tuple[str, LinkInertia], ...] = field(
        default=(),
        metadata=store_as(
            encode=lambda parts: [[name, _list_numbers(body)] for name, body in parts],
            decode=lambda parts: tuple((str(name), _read_body(body)) for name, body in parts),
        ),
    )
    negligible: bool = False

    @classmethod
    def of_parts(
        cls, name: str, parts: Sequence[tuple[str, LinkInertia]], *, known: bool = True
    ) -> Link:
        """Return the link of bodies that fixed joints hold together, all in the link's frame.

        A single body that has the link's name is no part of its own. Without bodies the inertia is
        zero, which is `known` or stands for one that is not given.
        """
        total = LinkInertia(
            np.sum([inertia.parameters for _, inertia in parts] or [np.zeros(10)], 0)
        )
        # A body of the link's name is the link itself.
        merged = [part for part, _ in parts] not in ([], [name])
        return cls(name, total, inertia_known=known, parts=tuple(parts) if merged else ())

    @property
    def has_mass(self) -> bool:
        """Whether the description gives its mass."""
        return self.inertia_known and self.inertia.mass > 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Name a frame fixed to a link, such as a flange or a merged link.

    `link` is its index, ROOT for the root link; `placement` is 4 x 4 [m].
    """

    name: str
    link: int
    placement: Array

    def __post_init__(self) -> None:
        object.__setattr__(
            self,
            "placement",
            check_placement(self.placement, f"the placement of frame {self.name!r}"),
        )


@dataclass(frozen=True, slots=True)
class Contact:
    """Name a frame at which the ground, or anything else, may push the robot.

    A force acts `radius` [m] below its origin, as under a ball, or at it where the radius is not
    stated; of a `flat` one a moment too, as under the sole of a foot.
    """

    frame: str
    flat: bool = False
    radius: float | None = None

    @classmethod
    def parse(cls, text: str) -> tuple[Contact, ...]:
        """Return the contacts of a list such as `left_foot:flat,right_foot:flat` or `toe:0.02`.

        Raises `UsageError` for one that makes no sense or is given twice.
        """
        found = [cls._parse_one(part) for part in text.split(",")]
        names = [contact.frame for contact in found if contact is not None]
        # A name that is empty or comes twice makes the set smaller.
        if None in found or len({*names, ""}) <= len(names):
            raise UsageError(
                "contacts are names of links or frames, each once, as in FL_FOOT,FR_FOOT; :flat"
                f" after a sole, or the radius [m] of a ball, as in toe:0.02; got {text!r}",
                value=text,
            )
        return tuple(contact for contact in found if contact is not None)

    @classmethod
    def _parse_one(cls, text: str) -> Contact | None:
        name, given, kind = (part.strip() for part in text.partition(":"))
        # No kind, or a sole.
        if not given or kind == "flat":
            return cls(name, flat=bool(given))
        try:
            radius = float(kind)
        except ValueError:
            return None
        return cls(name, radius=radius) if 0.0 <= radius < np.inf else None

    def __str__(self) -> str:
        kind = "flat" if self.flat else "" if self.radius is None else f"{self.radius!r}"
        return f"{self.frame}:{kind}" if kind else self.frame


@dataclass(frozen=True, eq=False)
class Geometry:
    """The kinematic arrays that the batched kernels take; n joints.

    `parent` (n,) int64, -1 for the root; `revolute` (n,) bool; `before_rotation`, `after_rotation`
    (n, 3, 3); `before_translation`, `after_translation` (n, 3); `gravity` (3,) m/s^2 in the root
    frame.
    """

    parent: Indices
    revolute: Mask
    before_rotation: Array
    before_translation: Array
    after_rotation: Array
    after_translation: Array
    gravity: Array

    def __repr__(self) -> str:
        return f"Geometry({self.parent.size} joints)"
