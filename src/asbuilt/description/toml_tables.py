"""The tables of asbuilt's robot file (TOML), checked field by field."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from asbuilt.arrays import Array
from asbuilt.description.finite import LARGEST
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import USUAL_GRAVITY, DriveValues, JointKind, JointLimits
from asbuilt.description.rotation import find_rotation_fault
from asbuilt.errors import DescriptionError
from asbuilt.registry import list_known_fields, suggest_name


def _refuse_truth(value: Any) -> Any:
    """Refuse `mass = true`, which would be 1."""
    if isinstance(value, bool):
        raise ValueError(f"a number is expected, got {str(value).lower()}")
    return value


NUMBER = BeforeValidator(_refuse_truth)
Number = Annotated[float, NUMBER]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST), NUMBER]
Positive = Annotated[float, Field(gt=0.0), NUMBER]
Gain = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=LARGEST), NUMBER]
Vector = tuple[Finite, Finite, Finite]
Length = Annotated[
    float | str,
    BeforeValidator(
        lambda value: (
            float(value) if isinstance(value, int) and not isinstance(value, bool) else value
        )
    ),
]
AngleUnit = Literal["rad", "deg"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


def _add_d(schema: dict[str, Any]) -> None:
    """Add the other name of `b` to the schema of a Denavit-Hartenberg row."""
    schema["properties"]["d"] = schema["properties"]["b"]


class DHTable(_Table):
    """Lengths [m] and angles of a Denavit-Hartenberg row; `d` is another name of `b`."""

    model_config = ConfigDict(json_schema_extra=_add_d)

    a: Finite = 0.0
    alpha: Finite = 0.0
    b: Finite = Field(default=0.0, validation_alias=AliasChoices("b", "d"))
    theta: Finite = 0.0


class PlacementTable(_Table):
    """A frame in another: `xyz` in m or named lengths, and `rpy` or a 3 x 3 `rotation`."""

    xyz: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    rpy: Vector | None = None
    rotation: tuple[Vector, Vector, Vector] | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> PlacementTable:
        fault = None if self.rotation is None else find_rotation_fault(self.rotation)
        if self.rpy is not None and self.rotation is not None:
            raise ValueError("give rpy or rotation, not both")
        if any(isinstance(value, float) and not math.isfinite(value) for value in self.xyz):
            raise ValueError(f"xyz must be finite, got {list(self.xyz)}")
        if fault:
            raise ValueError(f"rotation is not a rotation matrix: {fault}")
        return self


class TensorTable(_Table):
    """The six moments and products of inertia [kg m^2].

    A product is the entry of the tensor, `Ixy = -integral(x y dm)`.
    """

    Ixx: Finite
    Iyy: Finite
    Izz: Finite
    Ixy: Finite = 0.0
    Ixz: Finite = 0.0
    Iyz: Finite = 0.0

    @property
    def matrix(self) -> Array:
        """The symmetric 3 x 3 tensor."""
        return np.array(
            [
                [self.Ixx, self.Ixy, self.Ixz],
                [self.Ixy, self.Iyy, self.Iyz],
                [self.Ixz, self.Iyz, self.Izz],
            ]
        )


class MassTable(_Table):
    """Mass properties in the axes of the link's frame.

    The tensor about the centre of mass or about the frame's origin.
    """

    mass: Finite | None = None
    com: Vector | None = None
    first_moment: Vector | None = None
    inertia_about_com: TensorTable | None = None
    inertia_about_origin: TensorTable | None = None

    @model_validator(mode="after")
    def _complete(self) -> MassTable:
        given = [
            name
            for name in ("com", "first_moment", "inertia_about_com", "inertia_about_origin")
            if getattr(self, name) is not None
        ]
        if self.mass is None:
            if given:
                raise ValueError(
                    f"{given[0]} is given without mass; give mass too, or leave all mass"
                    " properties out"
                )
            return self
        if (self.com is None) == (self.first_moment is None):
            raise ValueError("give com or first_moment with mass, and only one of them")
        if (self.inertia_about_com is None) == (self.inertia_about_origin is None):
            raise ValueError(
                "give inertia_about_com or inertia_about_origin with mass, and only one of them"
            )
        if self.mass == 0.0 and not {"com", "inertia_about_origin"} & {*given}:
            raise ValueError("a link without mass has no centre of mass; give inertia_about_origin")
        return self

    @property
    def inertia(self) -> LinkInertia | None:
        """The ten parameters about the origin, or None where no mass properties are given."""
        if self.mass is None:
            return None
        if self.inertia_about_com is not None:
            com = (
                np.array(self.com)
                if self.com is not None
                else np.array(self.first_moment) / self.mass
            )
            return LinkInertia.from_com(self.mass, com, self.inertia_about_com.matrix)
        assert self.inertia_about_origin is not None
        moment = (
            np.array(self.first_moment)
            if self.first_moment is not None
            else self.mass * np.array(self.com)
        )
        return LinkInertia.from_origin(self.mass, moment, self.inertia_about_origin.matrix)


class PartTable(MassTable):
    """One of several bodies that make up a link, given in the frame of the link."""

    name: str


class LimitsTable(_Table):
    """Describe the limits of a joint.

    In the angle unit of the file (m for a prismatic joint), torque in N m (force in N).
    """

    lower: Number = -math.inf
    upper: Number = math.inf
    velocity: Positive = math.inf
    acceleration: Positive = math.inf
    jerk: Positive = math.inf
    torque: Positive = math.inf

    @model_validator(mode="after")
    def _sound(self) -> LimitsTable:
        self.in_si(1.0)
        return self

    def in_si(self, scale: float) -> JointLimits:
        """Return the limits as the robot model keeps them, for positions in units of `scale`."""
        given = {name: value * scale for name, value in self.model_dump().items()}
        return JointLimits(**given | {"torque": self.torque})


class DriveTable(_Table):
    """What is known of a drive.

    Armature [kg m^2], viscous [N m s/rad], coulomb [N m], offset [N m], all on the joint's side,
    the gear ratio, the gains kp [N m/rad] and kd [N m s/rad] of a position servo, and further
    terms.

    `terms` names terms of `asbuilt drives`, each with its parameters by symbol and its nonlinear
    parameters by name: `terms = {stribeck = {Fs = 0.3, velocity = 0.05}}`.
    """

    armature: Finite | None = None
    viscous: Finite | None = None
    coulomb: Finite | None = None
    offset: Finite | None = None
    gear_ratio: Finite | None = None
    kp: Gain | None = None
    kd: Gain | None = None
    terms: dict[str, dict[str, Finite]] = {}

    @model_validator(mode="after")
    def _sound(self) -> DriveTable:
        plain = [key for key in self.terms if key in type(self).model_fields]
        if plain:
            raise ValueError(
                f"{plain[0]} belongs next to terms, not among them: drive = {{{plain[0]} = 1.0}}"
            )
        if self.gear_ratio == 0.0:
            raise ValueError(
                "gear_ratio is how many turns of the motor make one of the joint, and cannot be 0"
            )
        return self

    @property
    def values(self) -> DriveValues:
        """The same as the robot model keeps them."""
        return DriveValues(**self.model_dump())


class MimicTable(_Table):
    """The joint that a joint follows: its position is `multiplier * position + offset`."""

    joint: str
    multiplier: Finite = 1.0
    offset: Finite = 0.0


class LinkTable(MassTable):
    """A link and the joint that moves it, placed by `dh` or by `origin`, `axis` and `after`."""

    name: str
    joint: str | None = None
    kind: JointKind = "revolute"
    parent: str | None = None
    dh: DHTable | None = None
    origin: PlacementTable | None = None
    axis: Vector | None = None
    after: PlacementTable | None = None
    parts: tuple[PartTable, ...] = ()
    limits: LimitsTable = LimitsTable()
    drive: DriveTable = DriveTable()
    mimic: MimicTable | None = None
    negligible: bool = False

    @model_validator(mode="after")
    def _one_geometry(self) -> LinkTable:
        if self.dh is not None and (self.axis is not None or self.after is not None):
            raise ValueError("a link placed by dh takes no axis and no after")
        if self.dh is None and self.origin is None:
            raise ValueError(
                "the link has no geometry: give dh = {...} or origin = {...} (origin = {} where the"
                " frames coincide)"
            )
        if self.axis is not None and math.hypot(*self.axis) == 0.0:
            raise ValueError("axis has length zero")
        if self.parts and self.mass is not None:
            raise ValueError("give the mass properties of the link or of its parts, not both")
        return self


class FrameTable(PlacementTable):
    """A named frame, such as a flange, fixed to a link or to the root link."""

    name: str
    link: str


class MotorTable(_Table):
    """A motor that is no joint: a coordinate of the robot, with a column in a log."""

    name: str
    limits: LimitsTable = LimitsTable()
    drive: DriveTable = DriveTable()


class CouplingTable(_Table):
    """How motors and joints turn together; one of two forms.

    `wrist = {motor_5 = 1.0, motor_6 = -0.8}` with `offset` says where a joint stands for positions
    of motors or of other joints. `motor` with `turns` says with which joints (or motors) the far
    side of a drive turns, which has friction and armature of its own.
    """

    model_config = ConfigDict(extra="allow", frozen=True)
    # No value: pydantic 2.7 takes what has one for a field, whose name it refuses.
    __pydantic_extra__: dict[str, dict[str, Finite]]

    motor: str | None = None
    turns: dict[str, Finite] = {}
    offset: Finite = 0.0

    @model_validator(mode="after")
    def _one_form(self) -> CouplingTable:
        moved = self.__pydantic_extra__ or {}
        if self.motor is not None and not moved:
            if not self.turns:
                raise ValueError("turns is missing: the share of each joint the motor turns with")
            return self
        if self.motor is not None or self.turns or len(moved) != 1:
            raise ValueError(
                "give one joint and what moves it, such as wrist = {motor_5 = 1.0}, or motor and"
                f" turns; got {', '.join((*self.model_fields_set,)) or 'nothing'}"
            )
        ((name, factors),) = moved.items()
        if not factors:
            raise ValueError(
                f"{name} must be a table of motors or joints with finite factors, such as"
                f" {name} = {{motor_5 = 1.0}}; got {factors!r}"
            )
        return self

    @property
    def joint(self) -> tuple[str, dict[str, float]] | None:
        """The joint and the factors of what moves it, None for the far side of a drive."""
        return next(iter((self.__pydantic_extra__ or {}).items()), None)


class LoopTable(_Table):
    """A loop: points of two links that coincide, or joints that move together.

    `kind` is connect (points), weld (frames, of which link b's is turned by `rpy` or `rotation` in
    link a's) or joint (the first of `joints` is at a `polynomial` of the second).
    """

    name: str = ""
    kind: Literal["connect", "weld", "joint"] = "connect"
    link_a: str = ""
    point_a: Vector = (0.0, 0.0, 0.0)
    link_b: str = ""
    point_b: Vector = (0.0, 0.0, 0.0)
    rpy: Vector | None = None
    rotation: tuple[Vector, Vector, Vector] | None = None
    joints: tuple[str, ...] = ()
    polynomial: tuple[Finite, ...] = ()

    @model_validator(mode="after")
    def _one_kind(self) -> LoopTable:
        given = self.model_fields_set
        wrong = given & (
            {"link_a", "point_a", "link_b", "point_b", "rpy", "rotation"}
            if self.kind == "joint"
            else {"joints", "polynomial", *(() if self.kind == "weld" else ("rpy", "rotation"))}
        )
        missing = set() if self.kind == "joint" else {"link_a", "link_b"} - given
        if wrong:
            raise ValueError(f"a loop of kind {self.kind} takes no {', '.join(sorted(wrong))}")
        if missing:
            raise ValueError(f"{' and '.join(sorted(missing))}: is missing; name the two links")
        if self.rpy is not None and self.rotation is not None:
            raise ValueError("give rpy or rotation, not both")
        return self


class SpringTable(_Table):
    """A spring or cylinder between points of two links, or a torsion spring at a joint.

    `stiffness` [N/m, N m/rad] and the `force` [N] of a cylinder at its `free_length` are
    identified where they are left out; the force grows by the share `progression` [1/m]; `rest`
    is in the angle unit of the file, or a position [m].
    """

    name: str = ""
    kind: Literal["extension", "cylinder", "torsion"] = "extension"
    link_a: str = ""
    point_a: Vector = (0.0, 0.0, 0.0)
    link_b: str = ""
    point_b: Vector = (0.0, 0.0, 0.0)
    free_length: Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=10.0)] = 0.0
    joint: str = ""
    rest: Finite = 0.0
    stiffness: Gain | None = None
    force: Finite | None = None
    progression: Gain = 0.0

    @model_validator(mode="after")
    def _one_kind(self) -> SpringTable:
        given = self.model_fields_set
        ends = {"link_a", "point_a", "link_b", "point_b", "free_length"}
        at_joint = {"joint", "rest"}
        needed = {"joint"} if self.kind == "torsion" else ends
        of_cylinder = {"force", "progression"}
        refused = {
            "extension": at_joint | of_cylinder,
            "cylinder": at_joint | {"stiffness"},
            "torsion": ends | of_cylinder,
        }[self.kind]
        wrong, missing = (", ".join(sorted(each)) for each in (given & refused, needed - given))
        if wrong:
            raise ValueError(f"a spring of kind {self.kind} takes no {wrong}")
        if missing:
            raise ValueError(f"{missing}: is missing for kind {self.kind}")
        return self


class RobotFile(_Table):
    """The whole file; with `extends`, its additions to another description."""

    name: str = ""
    extends: str = ""
    citation: str = ""
    notes: tuple[str, ...] = ()
    gravity: Vector = USUAL_GRAVITY
    root_link: str = "root"
    convention: Literal["standard", "modified"] | None = None
    angle_unit: AngleUnit = "rad"
    lengths: dict[str, Finite] = {}
    drives_by_design: bool = True
    usual_drive: str = ""
    links: tuple[LinkTable, ...] = ()
    frames: tuple[FrameTable, ...] = ()
    motors: tuple[MotorTable, ...] = ()
    couplings: tuple[CouplingTable, ...] = ()
    loops: tuple[LoopTable, ...] = ()
    springs: tuple[SpringTable, ...] = ()
    passive: tuple[str, ...] = ()
    posture: dict[str, Finite] = {}

    @property
    def angle(self) -> float:
        """Radians per angle unit of the file."""
        return math.pi / 180.0 if self.angle_unit == "deg" else 1.0

    @model_validator(mode="after")
    def _convention_stated(self) -> RobotFile:
        own = sorted(self.model_fields_set & BESIDE_OTHERS)
        missing = sorted({"name", "links"} - self.model_fields_set)
        if self.extends and own:
            raise ValueError(
                f"{', '.join(own)} cannot be given again for a robot that the file extends;"
                f" leave them to {self.extends}"
            )
        if not self.extends and missing:
            raise ValueError(f"{' and '.join(missing)}: is missing; or give extends")
        if not self.extends and not self.links:
            raise ValueError("links: Tuple should have at least 1 item, a robot needs a link")
        if self.convention is None and any(link.dh is not None for link in self.links):
            raise ValueError(
                'the file has dh rows but does not say which: add convention = "standard" or'
                ' convention = "modified"'
            )
        return self


BESIDE_OTHERS = frozenset(
    ("links", "frames", "lengths", "convention", "angle_unit", "root_link", "drives_by_design")
)
"""Fields of a file that describes all of a robot, not of one that extends another."""


def check_robot_file(content: dict[str, Any], source: str) -> RobotFile:
    """Return the checked file.

    Raises one `DescriptionError` that names file, table, field, what was given and what is
    expected.
    """
    try:
        return RobotFile.model_validate(content)
    except ValidationError as error:
        raise DescriptionError(_explain_error(source, content, error)) from None


def _explain_error(source: str, content: dict[str, Any], error: ValidationError) -> str:
    complaints = []
    problems = error.errors(include_url=False)
    deeper = {problem["loc"][0] for problem in problems if len(problem["loc"]) > 1}
    for problem in problems:
        if len(problem["loc"]) == 1 and problem["loc"][0] in deeper:
            continue
        table: Any = content
        place: list[str] = []
        for step in problem["loc"]:
            table = _step_inside(table, step)
            if isinstance(step, int):
                label = table.get("name", "") if isinstance(table, dict) else ""
                place[-1:] = [
                    f"{place[-1] if place else ''}[{step + 1}]" + (f" {label!r}" if label else "")
                ]
            elif step not in ("float", "str", "nullable"):
                place.append(str(step))
        message = problem["msg"].removeprefix("Value error, ")
        given = problem.get("input")
        if problem["type"] == "missing":
            message = "is missing"
        elif problem["type"] == "extra_forbidden":
            known = list_known_fields(RobotFile.model_json_schema(), problem["loc"][:-1])
            near = suggest_name(str(problem["loc"][-1]), known)
            message = f"is not a field of this table; {near}known are {', '.join(known)}"
        elif not isinstance(given, (dict, list)):
            message = f"{message}, got {given!r}"
        complaints.append(f"{'.'.join(place) or 'the file'}: {message}")
    complaints = list(dict.fromkeys(complaints))
    more = f" (and {len(complaints) - 3} more)" if len(complaints) > 3 else ""
    return f"{source}: " + "; ".join(complaints[:3]) + more


def _step_inside(table: Any, step: int | str) -> Any:
    """Return what stands at a step of a place, None where the step leads nowhere."""
    try:
        return table[step]
    except (KeyError, IndexError, TypeError):
        return None
