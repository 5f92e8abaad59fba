"""The robot file of asbuilt (TOML).

Denavit-Hartenberg rows or link placements, mass properties, limits, drives, citation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.description_format import (
    DESCRIPTION_FORMATS,
    DescriptionFormat,
    format_of,
)
from asbuilt.description.formats.dh import DHRow, build_dh_joint, dh_lengths, place_joint_on_origin
from asbuilt.description.formats.xml import LARGEST_DESCRIPTION
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.lengths import evaluate_lengths, parse_length, rotate_symbols
from asbuilt.description.model import (
    ROOT,
    DriveValues,
    Frame,
    Joint,
    JointLimits,
    Link,
    Loop,
    Mimic,
    RobotModel,
    Symbols,
)
from asbuilt.description.rotation import (
    compose_placements,
    placement,
    rotation_from_rpy,
    rotation_onto,
    snap_entries,
    straighten_angle,
)
from asbuilt.description.structure.couplings import couple_joints
from asbuilt.description.structure.springs import Spring, with_springs
from asbuilt.errors import AsbuiltError, DescriptionError
from asbuilt.untrusted import describe_problem, parse_toml, read_bytes, read_text

if TYPE_CHECKING:
    from asbuilt.description.toml_tables import (
        DHTable,
        LinkTable,
        PlacementTable,
        RobotFile,
    )

LONGEST_CHAIN = 8
"""Most robot files of which each extends the next."""


def read_robot_toml(path: str | Path) -> RobotModel:
    """Read a robot from a TOML file.

    Raises one `DescriptionError` that names file, table, field, value and cure.
    """
    path = Path(path)
    text = read_text(path, "description", DescriptionError)
    return robot_from_toml(text, source=str(path), folder=path.parent)


def robot_from_toml(
    text: str,
    *,
    source: str = "TOML text",
    folder: Path | None = None,
    close: bool = True,
) -> RobotModel:
    """Read a robot from the text of a TOML file; `source` names it in errors and in the model.

    `folder` is where a description is that the file extends. Loops are closed at once, or when they
    are first needed, which spares the compiler where robots are only listed.

    Raises `DescriptionError` as `read_robot_toml`.
    """
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise DescriptionError(
            f"{source}: this is not valid TOML: {describe_problem(error)}"
        ) from None
    # Other formats do without: pydantic takes as long to build the tables as to read a robot.
    from asbuilt.description.toml_tables import (  # noqa: PLC0415 - light start
        check_robot_file,
    )

    file = check_robot_file(content, source)
    try:
        model = (
            _extend_description(file, source, folder)
            if file.extends
            else _build_model(file, source)
        )
        model = with_springs(model, _read_springs(file, model)) if file.springs else model
        return model.closed() if close else model
    except AsbuiltError as error:
        raise DescriptionError(f"{source}: {error}") from None


@dataclass
class _Reading:
    """What grows while the links are read one after the other."""

    file: RobotFile
    lengths: dict[str, float]
    notes: list[str]

    def link_index(self, name: str, known: list[str], what: str) -> int:
        if name == self.file.root_link:
            return ROOT
        if name not in known:
            there = ", ".join([self.file.root_link, *known])
            raise DescriptionError(
                f"{what} is {name!r}, which is neither the root link nor an earlier link; known"
                f" here: {there}"
            )
        return known.index(name)

    def placed(self, table: PlacementTable, what: str, index: int) -> tuple[Array, Symbols | None]:
        """Return the 4 x 4 matrix and, where at least one length is named, symbols for all.

        Numbers among them get symbols such as `x3`.
        """
        if table.rotation is not None:
            R = snap_entries(table.rotation)
        else:
            angles = zip(("roll", "pitch", "yaw"), table.rpy or (0.0, 0.0, 0.0), strict=True)
            R = rotation_from_rpy(
                [
                    straighten_angle(value * self.file.angle, f"{name} of {what}", self.notes)
                    for name, value in angles
                ]
            )
        if not any(isinstance(value, str) for value in table.xyz):
            return placement(R, np.array(table.xyz, dtype=np.float64)), None
        symbols: Symbols = tuple(
            self.symbols(value, f"{axis}{index + 1}")
            for axis, value in zip("xyz", table.xyz, strict=True)
        )
        return placement(R, evaluate_lengths(symbols, self.lengths)), symbols

    def symbols(self, value: float | str, symbol: str) -> tuple[tuple[float, str], ...]:
        if isinstance(value, str):
            return parse_length(value, self.lengths)
        if value == 0.0:
            return ()
        while symbol in self.lengths:
            symbol += "_"
        self.lengths[symbol] = value
        return ((1.0, symbol),)

    def dh_joint(self, link: LinkTable, dh: DHTable, index: int, parent: int) -> Joint:
        row = DHRow(
            a=dh.a,
            alpha=dh.alpha * self.file.angle,
            b=dh.b,
            theta=dh.theta * self.file.angle,
            kind=link.kind,
            joint=link.joint or "",
            parent=parent,
            limits=self.limits(link),
            drive=link.drive.values,
        )
        joint = build_dh_joint(row, index, self.file.convention or "standard", self.notes)
        for symbol, value in dh_lengths(row, index).items():
            if self.lengths.setdefault(symbol, value) != value:
                raise DescriptionError(
                    f"the named length {symbol} = {self.lengths[symbol]} is also the symbol of link"
                    f" {link.name!r}, where it is {value}; give it another name"
                )
        if link.origin is not None:
            joint = place_joint_on_origin(
                joint, *self.placed(link.origin, f"origin of link {link.name!r}", index)
            )
        return joint

    def placed_joint(self, link: LinkTable, index: int, parent: int) -> Joint:
        from asbuilt.description.toml_tables import (  # noqa: PLC0415 - light start
            PlacementTable,
        )

        before, before_symbols = self.placed(
            link.origin or PlacementTable(), f"origin of link {link.name!r}", index
        )
        after, after_symbols = self.placed(
            link.after or PlacementTable(), f"after of link {link.name!r}", index
        )
        onto = (
            rotation_onto(np.array(link.axis) / math.hypot(*link.axis))
            if link.axis is not None
            else np.eye(3)
        )
        return Joint(
            name=link.joint or f"joint_{index + 1}",
            kind=link.kind,
            parent=parent,
            before=compose_placements(before, placement(onto)),
            after=compose_placements(placement(onto.T), after),
            limits=self.limits(link),
            drive=link.drive.values,
            before_symbols=before_symbols,
            after_symbols=(
                rotate_symbols(onto.T, after_symbols) if after_symbols is not None else None
            ),
        )

    def limits(self, link: LinkTable) -> JointLimits:
        return link.limits.in_si(1.0 if link.kind == "prismatic" else self.file.angle)


def _build_model(file: RobotFile, source: str) -> RobotModel:
    reading = _Reading(file, dict(file.lengths), list(file.notes))
    names = [link.name for link in file.links]
    joints: list[Joint] = []
    for i, link in enumerate(file.links):
        parent = (
            i - 1
            if link.parent is None
            else reading.link_index(link.parent, names[:i], f"parent of link {link.name!r}")
        )
        joint = (
            reading.placed_joint(link, i, parent)
            if link.dh is None
            else reading.dh_joint(link, link.dh, i, parent)
        )
        if link.mimic is not None:
            follows = link.mimic
            mimic = Mimic.of(joint.name, follows.joint, follows.multiplier, follows.offset)
            joint = replace(joint, mimic=mimic)
        joints.append(joint)
    frames = []
    for frame in file.frames:
        carrier = reading.link_index(frame.link, names, f"link of frame {frame.name!r}")
        frames.append(
            Frame(
                name=frame.name,
                link=carrier,
                placement=reading.placed(frame, f"frame {frame.name!r}", carrier)[0],
            )
        )
    coupled = _mark_passive(
        couple_joints(joints, _read_motors(file), _read_moved_joints(file)), file
    )
    return RobotModel(
        name=file.name,
        joints=coupled,
        loops=_read_loops(file),
        posture=_read_posture(file, coupled),
        links=tuple(_make_link(link) for link in file.links),
        gravity=np.array(file.gravity),
        root_link=file.root_link,
        frames=tuple(frames),
        lengths=reading.lengths,
        drives_by_design=file.drives_by_design,
        source=source,
        citation=file.citation,
        notes=tuple(reading.notes),
        motor_coupling=_build_motor_coupling(file, [joint.name for joint in coupled]),
        usual_drive=file.usual_drive,
    )


def _extend_description(file: RobotFile, source: str, folder: Path | None) -> RobotModel:
    """Return the robot of another description with the additions of a file."""
    path = (folder or Path()) / file.extends
    if not path.is_file():
        raise DescriptionError(f"extends names {path}, where there is no file")
    _refuse_long_chain(path)
    found = format_of(path, read_bytes(path, "description", DescriptionError, LARGEST_DESCRIPTION))
    if found is None:
        raise DescriptionError(f"extends names {path}, which is no description in a known format")
    model = found.read(path)
    every, links, frames = model.in_tree_order()
    joints = _mark_passive(couple_joints(every, _read_motors(file), _read_moved_joints(file)), file)
    changes = {
        name: getattr(file, name)
        for name in ("name", "citation", "usual_drive")
        if getattr(file, name)
    }
    if "gravity" in file.model_fields_set:
        changes["gravity"] = np.array(file.gravity)
    return replace(
        model,
        **changes,
        joints=joints,
        followers=(),
        links=links,
        frames=frames,
        loops=(*model.loops, *_read_loops(file)),
        posture={**model.posture, **_read_posture(file, joints)},
        motor_coupling=_build_motor_coupling(file, [joint.name for joint in joints]),
        notes=(*model.notes, *file.notes),
        source=source,
    )


def _refuse_long_chain(path: Path) -> None:
    """Raise `DescriptionError` if robot files extend one another too often, as in a circle."""
    chain = [path]
    while chain[-1].suffix.lower() == ".toml" and chain[-1].is_file():
        text = read_text(chain[-1], "description", DescriptionError)
        try:
            extended = parse_toml(text).get("extends")
        except ValueError:
            return  # reported where the file is read
        if not isinstance(extended, str) or not extended:
            return
        chain.append(chain[-1].parent / extended)
        if len(chain) > LONGEST_CHAIN:
            raise DescriptionError(
                f"more than {LONGEST_CHAIN} files extend one another, from {chain[0]} to"
                f" {chain[-1]}; let the last one describe the robot"
            )


def _read_motors(file: RobotFile) -> dict[str, tuple[JointLimits, DriveValues]]:
    """Return limits and drive of the motors that are no joints."""
    found = dict[str, tuple[JointLimits, DriveValues]]()
    for motor in file.motors:
        if motor.name in found:
            raise DescriptionError(f"motor {motor.name!r} is given twice")
        found[motor.name] = motor.limits.in_si(file.angle), motor.drive.values
    return found


def _read_moved_joints(file: RobotFile) -> dict[str, Mimic]:
    """Return what moves the joints that couplings name."""
    found = dict[str, Mimic]()
    for table in file.couplings:
        if table.joint is None:
            continue
        name, factors = table.joint
        if name in found:
            raise DescriptionError(
                f"two couplings say where joint {name!r} stands: {found[name]}, and"
                f" {Mimic(factors, table.offset)}; keep one"
            )
        found[name] = Mimic(factors, table.offset)
    return found


def _mark_passive(joints: Sequence[Joint], file: RobotFile) -> tuple[Joint, ...]:
    """Return the joints with those that the file names as passive."""
    names = [joint.name_in_tree for joint in joints]
    for name in file.passive:
        if name not in names:
            raise DescriptionError(
                f"passive names joint {name!r}, which does not exist; the joints are"
                f" {', '.join(names)}"
            )
    moved = next((j for j in joints if j.name_in_tree in file.passive and j.mimic), None)
    if moved is not None and not moved.is_passive:
        raise DescriptionError(
            f"joint {moved.name_in_tree!r} is passive, but a coupling moves it ({moved.mimic});"
            " keep one of the two"
        )
    return tuple(
        replace(joint, mimic=Mimic({})) if joint.name_in_tree in file.passive else joint
        for joint in joints
    )


def _read_loops(file: RobotFile) -> tuple[Loop, ...]:
    """Return the loops; angles of `rpy` are in the unit of the file, near right ones exact."""
    return tuple(
        Loop(
            **table.model_dump(exclude={"rpy", "rotation"}),
            rotation=snap_entries(
                rotation_from_rpy([file.angle * each for each in table.rpy or (0, 0, 0)])
                if table.rotation is None
                else table.rotation
            ),
        )
        for table in file.loops
    )


def _read_springs(file: RobotFile, model: RobotModel) -> tuple[Spring, ...]:
    """Return the springs, the rest of those that turn in radians."""
    slides = {joint.name for joint in model.joints if not joint.is_revolute}
    return tuple(
        Spring(
            **table.model_dump(exclude={"point_a", "point_b", "rest"}),
            point_a=np.array(table.point_a),
            point_b=np.array(table.point_b),
            rest=table.rest * (1.0 if table.joint in slides else file.angle),
        )
        for table in file.springs
    )


def _read_posture(file: RobotFile, joints: Sequence[Joint]) -> dict[str, float]:
    """Return the posture at which loops are closed [rad or m], angles of revolute joints scaled."""
    slides = {name for j in joints if not j.is_revolute for name in (j.name, j.name_in_tree)}
    return {
        name: value * (1.0 if name in slides else file.angle)
        for name, value in file.posture.items()
    }


def _build_motor_coupling(file: RobotFile, names: list[str]) -> Array | None:
    drives = [table for table in file.couplings if table.motor is not None]
    if not drives:
        return None
    coupling = np.eye(len(names))
    for table in drives:
        assert table.motor is not None
        for name in (table.motor, *table.turns):
            if name not in names:
                raise DescriptionError(
                    f"coupling of motor {table.motor!r} names joint {name!r}, which does not exist;"
                    f" the joints are {', '.join(names)}"
                )
        coupling[names.index(table.motor)] = [table.turns.get(name, 0.0) for name in names]
    return coupling


def _make_link(link: LinkTable) -> Link:
    if link.parts:
        parts = [(part.name, part.inertia or LinkInertia.zero()) for part in link.parts]
        return Link.of_parts(link.name, parts)
    inertia = link.inertia
    return Link(
        name=link.name,
        inertia=inertia or LinkInertia.zero(),
        inertia_known=inertia is not None or link.negligible,
        negligible=link.negligible,
    )


DESCRIPTION_FORMATS.register("toml", DescriptionFormat("TOML", (".toml",), read_robot_toml))
