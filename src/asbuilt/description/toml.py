"""The robot file of asbuilt (TOML): Denavit-Hartenberg rows or link placements, mass properties, limits, drives, citation."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from asbuilt.description.dh import DHRow, dh_joint, dh_lengths, joint_on_origin
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.lengths import length_values, parsed_length, rotated_letters
from asbuilt.description.model import ROOT, DriveValues, Frame, Joint, JointKind, JointLimits, Letters, Link, RobotModel
from asbuilt.description.rotation import Array, composed, placement, rotation_from_rpy, rotation_onto, snapped, straightened
from asbuilt.errors import AsbuiltError, DescriptionError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0)]
Vector = tuple[Finite, Finite, Finite]
Length = Annotated[
    float | str, BeforeValidator(lambda value: float(value) if isinstance(value, int) and not isinstance(value, bool) else value)
]
AngleUnit = Literal["rad", "deg"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class DHTable(_Table):
    """Lengths [m] and angles of a Denavit-Hartenberg row; `d` is another name of `b`."""

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
        if self.rpy is not None and self.rotation is not None:
            raise ValueError("give rpy or rotation, not both")
        if any(isinstance(value, float) and not math.isfinite(value) for value in self.xyz):
            raise ValueError(f"xyz must be finite, got {list(self.xyz)}")
        if self.rotation is not None:
            R = np.array(self.rotation)
            error = float(np.abs(R @ R.T - np.eye(3)).max())
            if error > 1e-6 or np.linalg.det(R) < 0.0:
                raise ValueError(
                    f"rotation is not a rotation matrix: R R^T differs from 1 by {error:.2g} and det R = {np.linalg.det(R):.6g}"
                )
        return self


class TensorTable(_Table):
    """The six moments and products of inertia [kg m^2]; a product is the entry of the tensor, `Ixy = -integral(x y dm)`."""

    Ixx: Finite
    Iyy: Finite
    Izz: Finite
    Ixy: Finite = 0.0
    Ixz: Finite = 0.0
    Iyz: Finite = 0.0

    @property
    def matrix(self) -> Array:
        """The symmetric 3 x 3 tensor."""
        return np.array([[self.Ixx, self.Ixy, self.Ixz], [self.Ixy, self.Iyy, self.Iyz], [self.Ixz, self.Iyz, self.Izz]])


class MassTable(_Table):
    """Mass properties in the axes of the link's frame; the tensor about the centre of mass or about the frame's origin."""

    mass: Finite | None = None
    com: Vector | None = None
    first_moment: Vector | None = None
    inertia_about_com: TensorTable | None = None
    inertia_about_origin: TensorTable | None = None

    @model_validator(mode="after")
    def _complete(self) -> MassTable:
        given = [name for name in ("com", "first_moment", "inertia_about_com", "inertia_about_origin") if getattr(self, name) is not None]
        if self.mass is None:
            if given:
                raise ValueError(f"{given[0]} is given without mass; give mass too, or leave all mass properties out")
            return self
        if (self.com is None) == (self.first_moment is None):
            raise ValueError("give com or first_moment beside mass, and only one of them")
        if (self.inertia_about_com is None) == (self.inertia_about_origin is None):
            raise ValueError("give inertia_about_com or inertia_about_origin beside mass, and only one of them")
        if self.first_moment is not None and self.inertia_about_com is not None and self.mass == 0.0:
            raise ValueError("a link without mass has no centre of mass; give inertia_about_origin")
        return self

    @property
    def inertia(self) -> LinkInertia | None:
        """The ten parameters about the origin, or None where no mass properties are given."""
        if self.mass is None:
            return None
        if self.inertia_about_com is not None:
            com = np.array(self.com) if self.com is not None else np.array(self.first_moment) / self.mass
            return LinkInertia.from_com(self.mass, com, self.inertia_about_com.matrix)
        assert self.inertia_about_origin is not None
        moment = np.array(self.first_moment) if self.first_moment is not None else self.mass * np.array(self.com)
        return LinkInertia.from_origin(self.mass, moment, self.inertia_about_origin.matrix)


class PartTable(MassTable):
    """One of several bodies that make up a link, given in the frame of the link."""

    name: str


class LimitsTable(_Table):
    """Limits of a joint in the angle unit of the file (m for a prismatic joint), torque in N m (force in N)."""

    lower: float = -math.inf
    upper: float = math.inf
    velocity: Positive = math.inf
    acceleration: Positive = math.inf
    jerk: Positive = math.inf
    torque: Positive = math.inf

    @model_validator(mode="after")
    def _ordered(self) -> LimitsTable:
        if not self.lower <= self.upper:
            raise ValueError(f"lower = {self.lower} must not exceed upper = {self.upper}")
        return self


class DriveTable(_Table):
    """What is known of a drive: armature [kg m^2], viscous [N m s/rad], coulomb [N m], offset [N m]."""

    armature: Finite | None = None
    viscous: Finite | None = None
    coulomb: Finite | None = None
    offset: Finite | None = None


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

    @model_validator(mode="after")
    def _one_geometry(self) -> LinkTable:
        if self.dh is not None and (self.axis is not None or self.after is not None):
            raise ValueError("a link placed by dh takes no axis and no after")
        if self.dh is None and self.origin is None:
            raise ValueError("the link has no geometry: give dh = {...} or origin = {...} (origin = {} where the frames coincide)")
        if self.axis is not None and math.hypot(*self.axis) == 0.0:
            raise ValueError("axis has length zero")
        if self.parts and self.mass is not None:
            raise ValueError("give the mass properties of the link or of its parts, not both")
        return self


class FrameTable(PlacementTable):
    """A named frame, such as a flange, fixed to a link or to the root link."""

    name: str
    link: str


class RobotFile(_Table):
    """The whole file."""

    name: str
    citation: str = ""
    notes: tuple[str, ...] = ()
    gravity: Vector = (0.0, 0.0, -9.81)
    root_link: str = "root"
    convention: Literal["standard", "modified"] | None = None
    angle_unit: AngleUnit = "rad"
    lengths: dict[str, Finite] = {}
    links: tuple[LinkTable, ...] = Field(min_length=1)
    frames: tuple[FrameTable, ...] = ()

    @model_validator(mode="after")
    def _convention_stated(self) -> RobotFile:
        if self.convention is None and any(link.dh is not None for link in self.links):
            raise ValueError('the file has dh rows but does not say which: add convention = "standard" or convention = "modified"')
        return self


def read_robot_toml(path: str | Path) -> RobotModel:
    """Read a robot from a TOML file; raises one `DescriptionError` that names file, table, field, value and cure."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DescriptionError(f"{path}: the file cannot be read as text: {error}") from None
    return robot_from_toml(text, source=str(path))


def robot_from_toml(text: str, *, source: str = "TOML text") -> RobotModel:
    """Read a robot from the text of a TOML file; `source` names it in errors and in the model."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DescriptionError(f"{source}: this is not valid TOML: {error}") from None
    try:
        file = RobotFile.model_validate(content)
    except ValidationError as error:
        raise DescriptionError(_explained(source, content, error)) from None
    try:
        return _model(file, source)
    except AsbuiltError as error:
        raise DescriptionError(f"{source}: {error}") from None


def _model(file: RobotFile, source: str) -> RobotModel:
    unit = math.pi / 180.0 if file.angle_unit == "deg" else 1.0
    notes = list(file.notes)
    lengths = dict(file.lengths)
    names = [link.name for link in file.links]
    joints, links = [], []
    for i, link in enumerate(file.links):
        parent = _link_index(link.parent, file, names[:i], f"parent of link {link.name!r}") if link.parent is not None else i - 1
        if link.dh is not None:
            joint, letters = _dh_joint(file, link, i, parent, unit, notes)
            clash = sorted(letter for letter in letters if letter in file.lengths and letters[letter] != file.lengths[letter])
            if clash:
                raise DescriptionError(f"the named length {clash[0]!r} is also the letter of a dh row; give it another name")
            lengths |= letters
        else:
            joint = _placed_joint(link, i, parent, unit, lengths, notes)
        joints.append(joint)
        links.append(_link(link))
    frames = []
    for frame in file.frames:
        index = _link_index(frame.link, file, names, f"link of frame {frame.name!r}")
        T, _ = _placement(frame, unit, lengths, f"frame {frame.name!r}", notes)
        frames.append(Frame(name=frame.name, link=index, placement=T))
    return RobotModel(
        name=file.name,
        joints=tuple(joints),
        links=tuple(links),
        gravity=np.array(file.gravity),
        root_link=file.root_link,
        frames=tuple(frames),
        lengths=lengths,
        source=source,
        citation=file.citation,
        notes=tuple(notes),
    )


def _link_index(name: str, file: RobotFile, known: list[str], what: str) -> int:
    if name == file.root_link:
        return ROOT
    if name not in known:
        raise DescriptionError(
            f"{what} is {name!r}, which is not the root link nor an earlier link; known here: {', '.join([file.root_link, *known])}"
        )
    return known.index(name)


def _link(link: LinkTable) -> Link:
    if link.parts:
        parts = tuple((part.name, part.inertia or LinkInertia.zero()) for part in link.parts)
        total = LinkInertia(np.sum([inertia.parameters for _, inertia in parts], axis=0))
        return Link(name=link.name, inertia=total, parts=parts)
    inertia = link.inertia
    return Link(name=link.name, inertia=inertia or LinkInertia.zero(), inertia_known=inertia is not None)


def _limits(link: LinkTable, unit: float) -> JointLimits:
    given, scale = link.limits, 1.0 if link.kind == "prismatic" else unit
    return JointLimits(
        lower=given.lower * scale,
        upper=given.upper * scale,
        velocity=given.velocity * scale,
        acceleration=given.acceleration * scale,
        jerk=given.jerk * scale,
        torque=given.torque,
    )


def _dh_joint(file: RobotFile, link: LinkTable, index: int, parent: int, unit: float, notes: list[str]) -> tuple[Joint, dict[str, float]]:
    assert link.dh is not None
    assert file.convention is not None
    row = DHRow(
        a=link.dh.a,
        alpha=link.dh.alpha * unit,
        b=link.dh.b,
        theta=link.dh.theta * unit,
        kind=link.kind,
        joint=link.joint or "",
        parent=parent,
        limits=_limits(link, unit),
        drive=DriveValues(**link.drive.model_dump()),
    )
    joint, letters = dh_joint(row, index, file.convention, notes), dh_lengths(row, index)
    if link.origin is not None:
        own = dict(file.lengths)
        origin, origin_letters = _placement(link.origin, unit, own, f"origin of link {link.name!r}", notes, index)
        joint, letters = joint_on_origin(joint, origin, origin_letters), letters | own
    return joint, letters


def _placed_joint(link: LinkTable, index: int, parent: int, unit: float, lengths: dict[str, float], notes: list[str]) -> Joint:
    assert link.origin is not None
    origin, letters = _placement(link.origin, unit, lengths, f"origin of link {link.name!r}", notes, index)
    onto = rotation_onto(np.array(link.axis) / math.hypot(*link.axis)) if link.axis is not None else np.eye(3)
    last, last_letters = _placement(link.after or PlacementTable(), unit, lengths, f"after of link {link.name!r}", notes, index)
    return Joint(
        name=link.joint or f"joint_{index + 1}",
        kind=link.kind,
        parent=parent,
        before=composed(origin, placement(onto)),
        after=composed(placement(onto.T), last),
        limits=_limits(link, unit),
        drive=DriveValues(**link.drive.model_dump()),
        before_letters=letters,
        after_letters=rotated_letters(onto.T, last_letters) if last_letters is not None else None,
    )


def _placement(
    table: PlacementTable, unit: float, lengths: dict[str, float], what: str, notes: list[str], index: int = 0
) -> tuple[Array, Letters | None]:
    """Return the 4 x 4 matrix and, where at least one length is named, letters for all; numbers among them get letters such as `x3`."""
    if table.rotation is not None:
        R = snapped(table.rotation)
    else:
        angles = zip(("roll", "pitch", "yaw"), table.rpy or (0.0, 0.0, 0.0), strict=True)
        R = rotation_from_rpy([straightened(value * unit, f"{name} of {what}", notes) for name, value in angles])
    if not any(isinstance(value, str) for value in table.xyz):
        return placement(R, np.array(table.xyz, dtype=np.float64)), None
    terms = []
    for axis, value in zip("xyz", table.xyz, strict=True):
        if isinstance(value, str):
            terms.append(parsed_length(value, lengths))
        elif value == 0.0:
            terms.append(())
        else:
            letter = f"{axis}{index + 1}"
            while letter in lengths:
                letter += "_"
            lengths[letter] = value
            terms.append(((1.0, letter),))
    letters = tuple(terms)
    return placement(R, length_values(letters, lengths)), letters


def _explained(source: str, content: dict[str, Any], error: ValidationError) -> str:
    complaints = []
    for problem in error.errors(include_url=False):
        table: Any = content
        place: list[str] = []
        for step in problem["loc"]:
            table = table[step] if isinstance(table, (list, dict)) and _has(table, step) else None
            if isinstance(step, int):
                label = table.get("name", "") if isinstance(table, dict) else ""
                place[-1:] = [f"{place[-1] if place else ''}[{step + 1}]" + (f" {label!r}" if label else "")]
            elif step not in ("float", "str", "nullable"):
                place.append(str(step))
        message = problem["msg"].removeprefix("Value error, ")
        given = problem.get("input")
        if problem["type"] == "missing":
            message = "is missing"
        elif problem["type"] == "extra_forbidden":
            message = "is not a field of this table; check the spelling"
        elif not isinstance(given, (dict, list)):
            message = f"{message}, got {given!r}"
        complaints.append(f"{'.'.join(place) or 'the file'}: {message}")
    complaints = list(dict.fromkeys(complaints))
    more = f" (and {len(complaints) - 3} more)" if len(complaints) > 3 else ""
    return f"{source}: " + "; ".join(complaints[:3]) + more


def _has(table: Any, step: int | str) -> bool:
    return step in table if isinstance(table, dict) else isinstance(step, int) and step < len(table)
