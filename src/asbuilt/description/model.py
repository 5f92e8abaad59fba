"""The robot: joints and links in topological order, gravity, limits and the names of everything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.rotation import checked_placement
from asbuilt.errors import DescriptionError
from asbuilt.tables import Column, Table

JointKind = Literal["revolute", "continuous", "prismatic"]
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
MOST_JOINTS = 100
"""Joints of the largest robot; a humanoid with hands has about 60."""
ROOT = -1
"""Parent index of a joint that hangs on the root link."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of one joint: rad or m for position and its derivatives, N m or N for torque.

    Infinite where unknown.

    Raises `DescriptionError` where they leave no position, or a limit is negative or not a number.
    """

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    acceleration: float = np.inf
    jerk: float = np.inf
    torque: float = np.inf

    def __post_init__(self) -> None:
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
class DriveValues:
    """What the description says of one drive.

    Armature [kg m^2], viscous [N m s/rad], Coulomb [N m], offset [N m]; None where silent.

    All are on the joint's side; `gear_ratio` is how many turns of the motor make one of the joint
    (rad per m where it slides), and takes them to the motor's. `terms` are further terms of the
    drive by key, each with its parameters by symbol and its nonlinear parameters by name:
    `{"stribeck": {"Fs": 0.3, "velocity": 0.05, "power": 2.0}}`.
    """

    armature: float | None = None
    viscous: float | None = None
    coulomb: float | None = None
    offset: float | None = None
    gear_ratio: float | None = None
    terms: Mapping[str, Mapping[str, float]] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Connect a parent link to the link of the same index.

    The pose of the link in its parent link is `before @ motion(q) @ after`, 4 x 4 matrices [m]; the
    motion is a rotation about z or a translation along z. Raises `DescriptionError` for another
    kind, and for matrices that are no placements.
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

    def __post_init__(self) -> None:
        kinds = get_args(JointKind)
        if self.kind not in kinds:
            raise DescriptionError(
                f"joint {self.name!r} is {self.kind!r}; known kinds: {', '.join(kinds)}"
            )
        object.__setattr__(
            self,
            "before",
            checked_placement(self.before, f"the placement before joint {self.name!r}"),
        )
        object.__setattr__(
            self, "after", checked_placement(self.after, f"the placement after joint {self.name!r}")
        )

    def __repr__(self) -> str:
        return f"Joint({self.name!r}, {self.kind!r}, parent={self.parent})"

    @property
    def is_revolute(self) -> bool:
        """Whether the joint turns (also without end) rather than slides."""
        return self.kind != "prismatic"


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """One moving rigid body.

    `inertia` is the sum of its `parts`, which remember bodies merged over fixed joints.

    `inertia_known` is False where the description gave none and zeros stand in.
    """

    name: str
    inertia: LinkInertia
    inertia_known: bool = True
    parts: tuple[tuple[str, LinkInertia], ...] = ()


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
            checked_placement(self.placement, f"the placement of frame {self.name!r}"),
        )


@dataclass(frozen=True, eq=False)
class Geometry:
    """The kinematic arrays that the batched kernels take; n joints.

    `parent` (n,) int64, -1 for the root; `revolute` (n,) bool; `before_rotation`, `after_rotation`
    (n, 3, 3); `before_translation`, `after_translation` (n, 3); `gravity` (3,) m/s^2 in the root
    frame.
    """

    parent: NDArray[np.int64]
    revolute: NDArray[np.bool_]
    before_rotation: Array
    before_translation: Array
    after_rotation: Array
    after_translation: Array
    gravity: Array

    def __repr__(self) -> str:
        return f"Geometry({self.parent.size} joints)"


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Describe a robot: joint i moves link i; every parent precedes its children.

    Fixed joints are already merged.

    `gravity` is the acceleration of free fall in the root frame [m/s^2]. `lengths` gives the value
    of each symbol that the joints use. `drives_by_design` is False where the joints' drive values
    are settings for a simulator (URDF, MJCF) rather than facts of the design. `motor_coupling` T
    (n, n) says how the motors turn with the joints, `motor velocity = T qd` in units of the joints
    (gear ratios divided out), where a motor turns with more than its own joint, as in the wrists of
    many arms; the motors' torques act on the joints by its transpose. None means T = 1. `source`
    says where the description came from, `citation` whose facts they are.
    """

    name: str
    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    gravity: Array = field(default_factory=lambda: np.array(USUAL_GRAVITY))
    root_link: str = "root"
    frames: tuple[Frame, ...] = ()
    lengths: Mapping[str, float] = field(default_factory=dict)
    drives_by_design: bool = True
    motor_coupling: Array | None = None
    source: str = ""
    citation: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        gravity = np.array(self.gravity, dtype=np.float64)
        if gravity.shape != (3,) or not np.all(np.isfinite(gravity)):
            raise DescriptionError(
                f"gravity of {self.name} must be three finite numbers, got"
                f" {np.asarray(self.gravity).tolist()}"
            )
        gravity.setflags(write=False)
        object.__setattr__(self, "gravity", gravity)
        if not self.joints:
            raise DescriptionError(
                f"{self.name} has no moving joint; a robot needs at least one revolute or prismatic"
                " joint"
            )
        if len(self.joints) > MOST_JOINTS:
            raise DescriptionError(
                f"{self.name} has {len(self.joints)} moving joints; at most {MOST_JOINTS} are read"
            )
        if len(self.joints) != len(self.links):
            raise DescriptionError(
                f"{self.name}: {len(self.joints)} joints but {len(self.links)} links; joint i must"
                " move link i"
            )
        for names, what in (
            ([j.name for j in self.joints], "joint"),
            ([link.name for link in self.links], "link"),
        ):
            repeated = sorted({name for name in names if names.count(name) > 1})
            if repeated:
                raise DescriptionError(f"{self.name}: {what} name {repeated[0]!r} is used twice")
        for i, joint in enumerate(self.joints):
            if not ROOT <= joint.parent < i:
                raise DescriptionError(
                    f"{self.name}: joint {joint.name!r} (number {i + 1}) precedes its parent link"
                    f" (index {joint.parent})"
                )
        for frame in self.frames:
            if not ROOT <= frame.link < len(self.links):
                raise DescriptionError(
                    f"{self.name}: frame {frame.name!r} is fixed to link index {frame.link}; the"
                    f" links are 0 to {len(self.links) - 1}, and {ROOT} for the root"
                )
        if self.motor_coupling is not None:
            coupling = np.array(self.motor_coupling, dtype=np.float64)
            if coupling.shape != (len(self.joints), len(self.joints)) or not np.all(
                np.isfinite(coupling)
            ):
                raise DescriptionError(
                    f"{self.name}: motor_coupling must be {len(self.joints)} x {len(self.joints)}"
                    f" finite numbers, got {coupling.shape}"
                )
            if abs(np.linalg.det(coupling)) < 1e-9:
                raise DescriptionError(
                    f"{self.name}: motor_coupling is singular: some motion of the joints turns no"
                    f" motor; got {coupling.tolist()}"
                )
            coupling.setflags(write=False)
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
            for joint, link in zip(self.joints, self.links, strict=True)
        )
        return Table(columns, rows, title=f"{self.name}: {self.n_joints} joints")

    @property
    def n_joints(self) -> int:
        """Number of joints, which is the number of links."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in model order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Link names in model order."""
        return tuple(link.name for link in self.links)

    @property
    def parents(self) -> tuple[int, ...]:
        """Index of each joint's parent link, ROOT for the root."""
        return tuple(joint.parent for joint in self.joints)

    @property
    def parameters(self) -> Array:
        """Standard inertial parameters of all links, shape (10 n,), link by link."""
        return np.concatenate([link.inertia.parameters for link in self.links])

    @property
    def geometry(self) -> Geometry:
        """The arrays that the kernels take."""
        return Geometry(
            parent=np.array(self.parents, dtype=np.int64),
            revolute=np.array([joint.is_revolute for joint in self.joints]),
            before_rotation=np.ascontiguousarray([joint.before[:3, :3] for joint in self.joints]),
            before_translation=np.ascontiguousarray([joint.before[:3, 3] for joint in self.joints]),
            after_rotation=np.ascontiguousarray([joint.after[:3, :3] for joint in self.joints]),
            after_translation=np.ascontiguousarray([joint.after[:3, 3] for joint in self.joints]),
            gravity=np.array(self.gravity),
        )

    @property
    def motor_shares(self) -> Array:
        """How motors turn with joints, shape (n, n).

        Rows are zero for motors that turn with their own joint alone.
        """
        n = self.n_joints
        T = np.eye(n) if self.motor_coupling is None else self.motor_coupling
        alone = np.count_nonzero(T, axis=1) <= 1
        return np.where(alone[:, None], 0.0, T)

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the joints from the root to `joint`, itself included, in order."""
        chain: list[int] = []
        while joint != ROOT:
            chain.append(joint)
            joint = self.joints[joint].parent
        return tuple(reversed(chain))

    def with_parameters(self, parameters: ArrayLike) -> RobotModel:
        """Return the same robot with other standard inertial parameters, shape (10 n,).

        Raises `DescriptionError` for another shape.
        """
        values = np.asarray(parameters, dtype=np.float64)
        if values.shape != (10 * self.n_joints,):
            raise DescriptionError(
                f"{self.name} has {10 * self.n_joints} inertial parameters, got shape"
                f" {values.shape}"
            )
        inertias = [LinkInertia(values[10 * i : 10 * i + 10]) for i in range(self.n_joints)]
        links = tuple(
            replace(link, inertia=inertia, inertia_known=True, parts=())
            for link, inertia in zip(self.links, inertias, strict=True)
        )
        return replace(self, links=links)

    def with_gravity(self, gravity: ArrayLike) -> RobotModel:
        """Return the same robot with another gravity [m/s^2] in the root frame."""
        return replace(self, gravity=np.asarray(gravity, dtype=np.float64))

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
