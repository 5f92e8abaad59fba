"""What a robot is made of: its fields, and the names, order and places of its joints and links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import make_plain, store_as
from asbuilt.description.structure.loops import Loop
from asbuilt.description.structure.parts import (
    ROOT,
    USUAL_GRAVITY,
    Contact,
    Frame,
    Joint,
    Link,
    MassRange,
    ancestors,
)
from asbuilt.errors import DescriptionError


@dataclass(frozen=True, eq=False)
class RobotParts:
    """Hold the parts of a robot, which `RobotModel` describes and checks."""

    name: str
    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    gravity: Array = field(default_factory=lambda: np.array(USUAL_GRAVITY))
    root_link: str = "root"
    frames: tuple[Frame, ...] = ()
    followers: tuple[Joint, ...] = ()
    loops: tuple[Loop, ...] = ()
    posture: Mapping[str, float] = field(default_factory=dict)
    lengths: Mapping[str, float] = field(default_factory=dict)
    drives_by_design: bool = True
    motor_coupling: Array | None = None
    locked_joints: Mapping[str, float] = field(default_factory=dict)
    held_followers: Mapping[str, str] = field(default_factory=dict)
    assumed_carriers: tuple[str, ...] = ()
    mass_ranges: tuple[MassRange, ...] = field(
        default=(),
        metadata=store_as(
            encode=lambda ranges: [[*make_plain(known).values()] for known in ranges],
            decode=lambda ranges: tuple(
                MassRange(tuple(links), lower, np.inf if upper is None else upper)
                for links, lower, upper in ranges
            ),
        ),
    )
    usual_drive: str = ""
    contacts: tuple[Contact, ...] = field(
        default=(),
        metadata=store_as(
            encode=lambda contacts: [*map(str, contacts)],
            decode=lambda texts: Contact.parse(",".join(texts)) if texts else (),
        ),
    )
    described_gravity: Array | None = None
    source: str = ""
    citation: str = ""
    notes: tuple[str, ...] = ()

    @property
    def n_joints(self) -> int:
        """Number of joints: columns of a log, and drives."""
        return len(self.joints)

    @property
    def n_links(self) -> int:
        """Number of moving links, each with ten inertial parameters."""
        return len(self.links)

    @property
    def is_one_to_one(self) -> bool:
        """Whether every joint has a drive and a column of its own."""
        return not self.loops and all(joint.mimic is None for joint in self.moving_joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in model order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Link names in model order."""
        return tuple(link.name for link in self.links)

    @property
    def moving_joints(self) -> tuple[Joint, ...]:
        """The joint that moves each link: those with a drive, then those that follow them."""
        return (*self.joints, *self.followers)

    @property
    def parents(self) -> tuple[int, ...]:
        """Index of the parent of each link, ROOT for the root."""
        return tuple(joint.parent for joint in self.moving_joints)

    @property
    def link_order(self) -> tuple[int, ...]:
        """The links in an order in which parents come before what they carry."""
        return tuple(order_tree(self.name, self.moving_joints, self.n_joints))

    def placed(self, name: str) -> tuple[int, Array]:
        """Return link and placement (4, 4) of a frame or a link by its name.

        Raises `DescriptionError` where there is none that moves.
        """
        moving = self.moving_places
        if name not in moving:
            raise DescriptionError(
                f"{self.name} has no moving link or frame {name!r}; it has {', '.join(moving)}",
                value=name,
                available=[*moving],
            )
        return moving[name]

    @property
    def moving_places(self) -> dict[str, tuple[int, Array]]:
        """Link and pose (4, 4) in it by name, of the links and frames that move."""
        return {name: place for name, place in self.places.items() if place[0] != ROOT}

    @property
    def places(self) -> dict[str, tuple[int, Array]]:
        """Link and pose (4, 4) in it by name, of the root link (`ROOT`), links and frames."""
        found = {self.root_link: (ROOT, np.eye(4))}
        found |= {link.name: (k, np.eye(4)) for k, link in enumerate(self.links)}
        for frame in self.frames:
            found.setdefault(frame.name, (frame.link, frame.placement))
        return found

    def place_of(self, name: str, point: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[int, Array]:
        """Return link and point (3,) in its axes for a point of a link, a frame or the root link.

        Raises `DescriptionError` for another name.
        """
        if name not in self.places:
            there = ", ".join((self.root_link, *self.link_names))
            raise DescriptionError(f"{self.name} has no link {name!r}; it has {there}")
        link, at = self.places[name]
        return link, at[:3, :3] @ np.asarray(point, dtype=np.float64) + at[:3, 3]

    @property
    def joined_points(self) -> tuple[tuple[int, Array], ...]:
        """Links and points (3,) in their axes at which loops hold them together, two a loop."""
        return tuple(
            self.place_of(*end) for loop in self.loops if loop.kind != "joint" for end in loop.ends
        )

    def in_tree_order(self) -> tuple[tuple[Joint, ...], tuple[Link, ...], tuple[Frame, ...]]:
        """Return the joints of all links, links and frames, parents before their children."""
        return self.in_order(self.link_order)

    def in_order(
        self, order: Sequence[int]
    ) -> tuple[tuple[Joint, ...], tuple[Link, ...], tuple[Frame, ...]]:
        """Return the joints of all links, links and frames in an order of the links."""
        every = self.moving_joints
        place = {link: i for i, link in enumerate(order)} | {ROOT: ROOT}
        return (
            tuple(replace(every[k], parent=place[every[k].parent]) for k in order),
            tuple(self.links[k] for k in order),
            tuple(replace(frame, link=place[frame.link]) for frame in self.frames),
        )

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the links from the root to the link of `joint`, itself included, in order."""
        return tuple(ancestors(self.moving_joints, joint))


def order_tree(robot: str, joints: Sequence[Joint], n_driven: int) -> list[int]:
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
        # Up to a link that is placed already, or the root.
        while at != ROOT and at not in order:
            # Driven joints keep their order, which is the order of a log's columns.
            if at in waiting or (at < n_driven and link < at):
                raise DescriptionError(
                    f"{robot}: joint {joints[link].name!r} (number {link + 1}) precedes its parent"
                    f" link (index {joints[link].parent})"
                )
            waiting.append(at)
            at = joints[at].parent
        order += reversed(waiting)
    return order
