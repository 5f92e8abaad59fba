"""The robot: joints and links in topological order, gravity, limits and the names of everything."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.structure.couplings import (
    Coupling,
    derive_coupling,
    separate_followers,
    with_rotors,
)
from asbuilt.description.structure.free_base import JOINTS_OF, classify_base
from asbuilt.description.structure.joint_map import JointMap, OneToOne, TreeMotion
from asbuilt.description.structure.locking import lock_joints
from asbuilt.description.structure.loops import Loop
from asbuilt.description.structure.parts import (
    PLAIN_TERMS,
    ROOT,
    USUAL_GRAVITY,
    BaseKind,
    Contact,
    DriveValues,
    Frame,
    Geometry,
    Joint,
    JointKind,
    JointLimits,
    Link,
    MassRange,
    Mimic,
    Symbols,
)
from asbuilt.description.structure.robot import RobotParts, order_tree
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Cure, join_names
from asbuilt.tables import Column, Table

if TYPE_CHECKING:
    from asbuilt.description.structure.closure import Closure

__all__ = [
    "PLAIN_TERMS",
    "ROOT",
    "USUAL_GRAVITY",
    "Contact",
    "DriveValues",
    "Frame",
    "Geometry",
    "Joint",
    "JointKind",
    "JointLimits",
    "Link",
    "Loop",
    "MassRange",
    "Mimic",
    "RobotModel",
    "Symbols",
]

MOST_JOINTS = 100
"""Joints of the largest robot; a humanoid with hands has about 60."""


@dataclass(frozen=True, eq=False)
class RobotModel(RobotParts):
    """Describe a robot: joint i moves link i; every parent precedes its children.

    Fixed joints are already merged. Joints that follow others (`mimic`) have no drive and no column
    in a log: the constructor sets them apart as `followers`, whose links come after the links of
    the `joints`. So do passive joints, which `loops` place; `posture` says where joints are, by
    name, when the loops are closed, roughly [rad or m]. Where no joint is named passive, the joints
    without a drive are, or else the last ones of each chain. The names of `joints` also name
    the coordinates of the robot: columns of a log, drives. A joint that several of them move, or
    one by a factor, says so in its `mimic`.

    `gravity` is the acceleration of free fall in the root frame [m/s^2], `described_gravity` the
    one of the description where a tilt of the base was found since. `lengths` gives the value
    of each symbol that the joints use. `drives_by_design` is False where the joints' drive values
    are settings for a simulator (URDF, MJCF) rather than facts of the design. `motor_coupling` T
    (n, n) says how the motors turn with the joints, `motor velocity = T qd` in units of the joints
    (gear ratios divided out), where a motor turns with more than its own joint, as in the wrists of
    many arms; the motors' torques act on the joints by its transpose. None means T = 1.
    `locked_joints` gives the positions [rad or m] of joints that were taken out by `locked`, and
    `held_followers` those among them that follow a joint which moves, with that joint;
    `assumed_carriers` those that carry a joint which moves, or move it too, at a position that
    nobody gave.
    `mass_ranges` bound masses from sources other than the description, such as a scale.
    `usual_drive` names the drive terms that this robot calls for, empty for those that the source
    of its torques calls for.
    `contacts` are where forces that nobody measures may act on a robot with a free base.
    `source` says where the description came from, `citation` whose facts they are.
    """

    def __post_init__(self) -> None:
        gravity = read_only(self.gravity)
        if gravity.shape != (3,) or not np.all(np.isfinite(gravity)):
            raise DescriptionError(
                f"gravity of {self.name} must be three finite numbers, got"
                f" {np.asarray(self.gravity).tolist()}"
            )
        object.__setattr__(self, "gravity", gravity)
        if len(self.joints) + len(self.followers) == len(self.links):
            if not all(joint.has_motor for joint in self.joints):
                self._set_followers_apart()
            if self.loops and not any(joint.is_passive for joint in self.followers):
                self._set_passive_joints()
        every = self.moving_joints
        if not self.joints:
            raise DescriptionError(
                f"{self.name} has no moving joint; a robot needs at least one revolute or prismatic"
                " joint"
            )
        if len(every) > MOST_JOINTS:
            raise DescriptionError(
                f"{self.name} has {len(every)} moving joints; at most {MOST_JOINTS} are read"
            )
        if len(every) != len(self.links):
            raise DescriptionError(
                f"{self.name}: {len(every)} joints but {len(self.links)} links; joint i must"
                " move link i"
            )
        for names, what in (
            ([j.name for j in every], "joint"),
            ([j.name_in_tree for j in every], "joint"),
            ([link.name for link in self.links], "link"),
        ):
            repeated = sorted({name for name in names if names.count(name) > 1})
            if repeated:
                raise DescriptionError(f"{self.name}: {what} name {repeated[0]!r} is used twice")
        order_tree(self.name, every, len(self.joints))
        passive = [joint.name for joint in every if joint.is_passive]
        if passive and not self.loops:
            raise DescriptionError(
                f"{self.name}: joint {passive[0]!r} is passive, but no loop places it; give the"
                " loops, or a motor"
            )
        if not self.loops:
            # Contradictory couplings are refused here; loops are closed when first needed.
            self.closed()
        for frame in self.frames:
            if not ROOT <= frame.link < len(self.links):
                raise DescriptionError(
                    f"{self.name}: frame {frame.name!r} is fixed to link index {frame.link}; the"
                    f" links are 0 to {len(self.links) - 1}, and {ROOT} for the root"
                )
        for name in (name for known in self.mass_ranges for name in known.links):
            if name not in self.link_names:
                raise DescriptionError(
                    f"{self.name} has no moving link {name!r}, whose mass is given; its moving"
                    f" links are {', '.join(self.link_names)}"
                )
        for contact in self.contacts:
            self.placed(contact.frame)
        if self.motor_coupling is not None:
            coupling = read_only(self.motor_coupling)
            if coupling.shape != (len(self.joints), len(self.joints)) or not np.all(
                np.isfinite(coupling)
            ):
                raise DescriptionError(
                    f"{self.name}: motor_coupling must be {len(self.joints)} x {len(self.joints)}"
                    f" finite numbers, got {coupling.shape}"
                )
            if abs(np.linalg.det(coupling)) < 1e-9 and self.is_one_to_one:
                raise DescriptionError(
                    f"{self.name}: motor_coupling is singular: some motion of the joints turns no"
                    f" motor; got {coupling.tolist()}"
                )
            object.__setattr__(self, "motor_coupling", coupling)

    def __repr__(self) -> str:
        return f"RobotModel\n{self._table().as_text()}"

    def _repr_html_(self) -> str:
        return self._table().as_html()

    def _table(self) -> Table:
        """Return one row per joint with the link that it moves."""
        columns = (
            Column("joint"),
            Column("kind"),
            Column("on"),
            Column("moves"),
            Column("mass", "kg", "decimal", ".4g"),
        )
        rows = tuple(
            (
                joint.name,
                joint.kind,
                self.root_link if joint.parent == ROOT else self.links[joint.parent].name,
                link.name,
                link.inertia.mass if link.inertia_known else None,
            )
            for joint, link in zip(self.moving_joints, self.links, strict=True)
        )
        return Table(columns, rows, title=f"{self.name}: {self.n_joints} joints")

    @property
    def has_masses(self) -> bool:
        """Whether the description gives the mass of some link."""
        return any(link.has_mass for link in self.links)

    @property
    def has_every_mass(self) -> bool:
        """Whether the description gives the mass of each link."""
        return all(link.has_mass for link in self.links)

    @property
    def n_floating(self) -> int:
        """Number of coordinates of the base, which come first: 6, 3 if planar, 0 if it is fixed."""
        return len(JOINTS_OF[self.base_kind])

    @property
    def base_kind(self) -> BaseKind:
        """How the base can move."""
        return classify_base(self.joints, self.links)

    @property
    def driven_joints(self) -> range:
        """Which joints have a drive, counted from 0: all but those of a base that can move."""
        return range(self.n_floating, self.n_joints)

    @property
    def has_reactions(self) -> bool:
        """Whether forces may act that nobody measures, and are projected out of all equations.

        Every row then has parts of all joints.
        """
        return bool(self.contacts)

    @property
    def mixes_joints(self) -> bool:
        """Whether every equation has parts of all joints, as on a free base.

        Then no joint has a delay or causes of its own.
        """
        return self.n_floating > 0

    def require_root(self, reason: str) -> None:
        """Raise `UsageError` with a reason if the base can move."""
        if self.n_floating:
            raise UsageError(
                f"{self.name} has a free base, and {reason}",
                cure=Cure(
                    "hold its base, if it hangs or stands clamped", settings={"fixed_base": True}
                ),
            )

    def require_no_reactions(self) -> None:
        """Raise `UsageError` if forces may act at which trajectories jump.

        A refinement follows how trajectories depend on parameters, which jumps where feet strike.
        """
        if self.contacts:
            raise UsageError(
                f"{self.name} touches the ground, and a refinement by trajectories simulates none,"
                " since how they depend on the parameters jumps where feet strike",
                cure=Cure(
                    "leave the refinement out, and compare rollouts", {"rollout": "0.05,0.1,0.2"}
                ),
            )

    @cached_property
    def on_held_base(self) -> RobotModel:
        """The robot with its base held still at zero; itself on a fixed root."""
        held = dict.fromkeys(self.joint_names[: self.n_floating], 0.0)
        return replace(self.locked(held), locked_joints=self.locked_joints) if held else self

    @property
    def link_joints(self) -> tuple[int, ...]:
        """Coordinate that moves the joint of each link, counted from 0; of several the foremost.

        That is the joint's own, else the one with the largest factor.
        """
        n = self.n_joints
        return (*range(n), *np.argmax(np.abs(self.joint_map.of_links[n:]), axis=1).tolist())

    @property
    def link_shares(self) -> Array:
        """How far the joint of each link moves per unit of each coordinate, (n_links, n_joints)."""
        return self.joint_map.of_links

    @property
    def tool_link(self) -> int:
        """Link that carries a tool: the last drive's; below fingers, the one that has them.

        Where loops place joints, it is the link of the last frame, if a frame is on a link; on a
        free base it is the base. Fingers are links of different branches that one drive moves.

        Examples
        --------
        >>> from asbuilt.description.load import bundled_robot
        >>> bundled_robot("puma-560").tool_link
        5
        """
        carriers = [frame.link for frame in self.frames if frame.link != ROOT]
        if self.loops and carriers:
            return carriers[-1]
        if self.n_floating:
            return self.n_floating - 1
        parents = self.parents
        link = self.n_joints - 1
        driven = [set(np.flatnonzero(row).tolist()) for row in self.link_shares]
        while (up := parents[link]) != ROOT and any(
            parent == up and driven[other] == driven[link]
            for other, parent in enumerate(parents)
            if other != link
        ):
            link = up
        return link

    @cached_property
    def joint_map(self) -> JointMap:
        """How the joints of all links move with the coordinates."""
        if self.loops:
            # numba is slow to import, and most robots have no loops
            from asbuilt.description.structure.closure import derive_closure  # noqa: PLC0415

            return derive_closure(self)
        if self.is_one_to_one:
            return OneToOne(self.n_joints)
        return derive_coupling(self)

    @property
    def closure(self) -> Closure | None:
        """The `joint_map` of a robot with loops, None without."""
        return cast("Closure", self.joint_map) if self.loops else None

    def closed(self) -> RobotModel:
        """Return the robot itself; raises `DescriptionError` where its joints cannot move so."""
        # Deriving the map resolves the couplings, or closes the loops, once.
        _ = self.joint_map
        return self

    def constant_map(self, purpose: str) -> Coupling | OneToOne:
        """Return the `joint_map` where its shares are constant.

        Raises `DescriptionError`, which names the `purpose`, for a robot with loops.
        """
        found = self.joint_map
        if isinstance(found, (Coupling, OneToOne)):
            return found
        names = join_names([str(loop) for loop in self.loops])
        raise DescriptionError(
            f"{purpose} needs a robot whose joints move by constant shares of the motors;"
            f" {self.name} has closed chains ({names})",
            loops=[str(loop) for loop in self.loops],
        )

    def _set_passive_joints(self) -> None:
        """Take the joints of loops that have no motor for passive."""
        from asbuilt.description.structure.closure import find_passive_joints  # noqa: PLC0415

        found = find_passive_joints(self)
        object.__setattr__(
            self,
            "joints",
            tuple(
                replace(joint, mimic=Mimic({})) if joint.name in found else joint
                for joint in self.joints
            ),
        )
        if found:
            note = f"{join_names(found, len(found))} taken for passive; name them if others are"
            object.__setattr__(self, "notes", (*self.notes, note))
            self._set_followers_apart()

    @cached_property
    def tree(self) -> RobotModel:
        """The robot with a drive at every joint, in the order of `joint_map`; or itself."""
        if self.is_one_to_one:
            return self
        joints, links, frames = self.in_tree_order()
        return replace(
            self,
            joints=tuple(replace(joint, name=joint.name_in_tree, mimic=None) for joint in joints),
            links=links,
            frames=frames,
            followers=(),
            loops=(),
            posture={},
            motor_coupling=None,
            usual_drive="",
        )

    @property
    def with_rotors(self) -> RobotModel:
        """The robot with a joint for every coordinate; itself where that is so.

        Its motors that are no joints turn rotors without weight.
        """
        return with_rotors(self, self.motor_shares)

    def _set_followers_apart(self) -> None:
        """Move joints that follow others behind those that have a drive."""
        for name, part in separate_followers(self).items():
            object.__setattr__(self, name, part)

    @property
    def parameters(self) -> Array:
        """Standard inertial parameters of all links, shape (10 n,), link by link."""
        return np.concatenate([link.inertia.parameters for link in self.links])

    @property
    def geometry(self) -> Geometry:
        """The arrays that the kernels take, of all links in the order of `tree`."""
        joints = self.tree.joints
        return Geometry(
            parent=np.array(self.tree.parents, dtype=np.int64),
            revolute=np.array([joint.is_revolute for joint in joints]),
            before_rotation=np.ascontiguousarray([joint.before[:3, :3] for joint in joints]),
            before_translation=np.ascontiguousarray([joint.before[:3, 3] for joint in joints]),
            after_rotation=np.ascontiguousarray([joint.after[:3, :3] for joint in joints]),
            after_translation=np.ascontiguousarray([joint.after[:3, 3] for joint in joints]),
            gravity=np.array(self.gravity),
        )

    @property
    def motor_shares(self) -> Array:
        """How the far side of each drive turns with the coordinates, shape (n, n).

        Where joints are logged, that is a motor that turns with several of them
        (`motor_coupling`); where motors are logged, a joint that several of them turn. Rows are
        zero for drives of which both sides turn together.
        """
        n = self.n_joints
        T = np.eye(n) if self.motor_coupling is None else self.motor_coupling
        T = np.where(np.all(np.eye(n) == T, axis=1)[:, None], self.link_shares[:n], T)
        return np.where((np.count_nonzero(T, axis=1) <= 1)[:, None], 0.0, T)

    def link_positions(self, q: Array) -> Array:
        """Return the positions (..., n_links) of the joints of all links, for q (..., n_joints).

        Raises `MotionError` where loops do not close.
        """
        moved = self.link_motion(np.reshape(q, (-1, self.n_joints))).q
        return moved.reshape(*np.shape(q)[:-1], self.n_links)

    def link_motion(
        self, q: Array, qd: Array | None = None, qdd: Array | None = None
    ) -> TreeMotion:
        """Return the motion (N, n_links) of the joints of all links, in the order of the links.

        `q`, `qd`, `qdd` are (N, n_joints); rates not given are zero. Raises `MotionError` where
        loops do not close.
        """
        moved = self.joint_map.motion(q, qd, qdd)
        by_link = self.joint_map.by_link
        shares = moved.shares[..., np.argsort(self.joint_map.order), :]
        return TreeMotion(by_link(moved.q), by_link(moved.qd), by_link(moved.qdd), shares)

    def with_parameters(self, parameters: ArrayLike) -> RobotModel:
        """Return the same robot with other standard inertial parameters, shape (10 n,).

        Raises `DescriptionError` for another shape.
        """
        values = np.asarray(parameters, dtype=np.float64)
        if values.shape != (10 * self.n_links,):
            raise DescriptionError(
                f"{self.name} has {10 * self.n_links} inertial parameters, got shape {values.shape}"
            )
        links = tuple(
            replace(link, inertia=LinkInertia(own), inertia_known=True, parts=())
            for link, own in zip(self.links, values.reshape(-1, 10), strict=True)
        )
        return replace(self, links=links)

    def locked(self, joints: Mapping[str, float | None] | Iterable[str]) -> RobotModel:
        """Return the same robot with some joints held still.

        The link of a locked joint is merged into the link that carries it, as over a fixed joint:
        its name stays as a frame and as a part. Joints that mimic a locked joint are locked too.

        Parameters
        ----------
        joints
            Joints with their positions [rad or m]; without one, or with None, 0, or the middle of
            the limits if 0 lies outside them, or what a mimic joint follows.

        Returns
        -------
        RobotModel
            The robot with the other joints; `locked_joints` has the positions.

        Raises
        ------
        DescriptionError
            If there is no such joint, no joint is left, or motors that stay are coupled to a
            joint locked.

        Examples
        --------
        >>> from asbuilt.description.load import bundled_robot
        >>> elbow = bundled_robot("two-link").locked({"joint_2": 0.5})
        >>> elbow.joint_names, elbow.locked_joints
        (('joint_1',), {'joint_2': 0.5})
        """
        return lock_joints(self, joints)

    def with_gravity(self, gravity: ArrayLike) -> RobotModel:
        """Return the same robot with another gravity [m/s^2] in the root frame."""
        return replace(self, gravity=np.asarray(gravity, dtype=np.float64))

    def tilted(self, gravity: Array) -> RobotModel:
        """Return the same robot on a base whose tilt makes gravity point so [m/s^2]."""
        return replace(self, gravity=gravity, described_gravity=self.as_described.gravity)

    @property
    def as_described(self) -> RobotModel:
        """The robot without the tilt of the base that was found."""
        if self.described_gravity is None:
            return self
        return replace(self, gravity=self.described_gravity, described_gravity=None)

    def with_limits(self, limits: Sequence[JointLimits]) -> RobotModel:
        """Return the same robot with other joint limits, one per joint.

        Raises `DescriptionError` for another number of them.
        """
        if len(limits) != self.n_joints:
            raise DescriptionError(
                f"{self.name} has {self.n_joints} joints, got {len(limits)} limits; give one per"
                " joint"
            )
        joints = tuple(
            replace(joint, limits=limit) for joint, limit in zip(self.joints, limits, strict=True)
        )
        return replace(self, joints=joints)
