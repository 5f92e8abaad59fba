"""Robots from URDF (Unified Robot Description Format), without their meshes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.finite import parse_finite_number
from asbuilt.description.formats.description_format import DESCRIPTION_FORMATS, DescriptionFormat
from asbuilt.description.formats.xml import (
    close_match,
    described_text,
    find_outermost_tag,
    parse_xml,
    read_number,
    read_numbers,
    read_origin,
    require_attribute,
)
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import (
    ROOT,
    DriveValues,
    Frame,
    Joint,
    JointKind,
    JointLimits,
    Link,
    Mimic,
    RobotModel,
)
from asbuilt.description.rotation import (
    SCALED,
    compose_placements,
    condense_notes,
    placement,
    rotation_from_rpy,
    rotation_onto,
    straighten_angle,
)
from asbuilt.description.structure.free_base import clear_base_inertias, free_urdf
from asbuilt.description.structure.parts import BaseKind
from asbuilt.errors import DescriptionError
from asbuilt.findings import Cure, join_names

MOVING: dict[str, JointKind] = {
    "revolute": "revolute",
    "continuous": "continuous",
    "prismatic": "prismatic",
}
HELD_OR_REPLACED = {
    "floating": Cure(
        "hold it at its pose if the robot hangs in the air or stands clamped, or replace it by"
        ' type="fixed"',
        settings={"fixed_base": True},
    ),
    "planar": Cure('replace it by type="fixed" or by a chain of those'),
}
"""What to do with joints of several freedoms, by type."""
AXIS_TOLERANCE = 1e-6
"""An axis whose length differs from 1 by more is scaled to unit length with a note."""


_Bodies = dict[str, LinkInertia | None]
"""The inertia of each link of the file by name, None where it gives none."""


@dataclass(frozen=True)
class _Connection:
    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    element: Element
    place: str


@dataclass
class _Tree:
    """Gather what has been merged so far; `parts[i]` belong to moving link i, in its frame."""

    joints: list[Joint] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    parts: list[list[tuple[str, LinkInertia]]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)


def read_urdf(
    path_or_text: str | Path | bytes,
    *,
    straighten: bool = True,
    fixed_base: bool = False,
    base: BaseKind = "fixed",
) -> RobotModel:
    """Read a robot from a URDF file or from the XML text itself.

    The frame of a moving link is the URDF link frame; `before` ends with a rotation of z onto the
    joint axis, which `after` takes back. Links behind fixed joints are merged into the moving link
    that carries them, and kept as frames and as `Link.parts` (all in the frame of the carrier);
    what is fixed to the root link does not move and its inertia is dropped. `<dynamics>` damping
    and friction become viscous and Coulomb values, rotor inertia and ratio of `<transmission>` an
    armature. Angles within 1e-5 rad of a right angle become
    exact, unless `straighten` is False, which reads them to the letter as other programs do. Meshes
    are neither needed nor looked for. `fixed_base` holds floating joints at their origin; a free or
    planar `base` puts the root link on joints that have no drive.

    Raises `DescriptionError` naming the element, what was given and what would do (format:
    http://wiki.ros.org/urdf/XML).
    """
    content, source = described_text(path_or_text)
    root = parse_xml(content, source)
    if root.tag == "mujoco":
        raise DescriptionError(
            f"{source}: this is a MuJoCo model (MJCF), not a URDF; load it with load_robot or"
            " read_mjcf"
        )
    if root.tag != "robot":
        raise DescriptionError(
            f"{source}: the outermost element is <{root.tag}>; a URDF has <robot name=...>"
        )
    held = _fix_floating_joints(root) if fixed_base else []
    if base != "fixed":
        free_urdf(root, base, source)
    notes = [f"the floating joint {name!r} is held at its origin" for name in held]
    bodies = _read_bodies(root, source, notes, straighten)
    connections = _read_connections(root, bodies, source, notes, straighten)
    top = _find_root_link(bodies, connections, source)
    tree = _merge_fixed(top, bodies, connections, source, notes)
    if not tree.joints:
        raise DescriptionError(
            f"{source}: no joint moves (revolute, continuous or prismatic), so there is nothing to"
            " identify"
        )
    _drop_fixed_mimics(tree.joints, connections, notes)
    _add_transmissions(tree.joints, root, source, notes)
    links = [
        Link.of_parts(name, parts, known=bool(parts))
        for name, parts in zip(tree.links, tree.parts, strict=True)
    ]
    return RobotModel(
        drives_by_design=False,
        name=(root.get("name") or "robot").strip(),
        joints=tuple(tree.joints),
        links=clear_base_inertias(source, tree.joints, links, base),
        root_link=top,
        frames=tuple(tree.frames),
        source="URDF text" if source == "the description" else source,
        notes=condense_notes([note.replace(f"{source}, ", "") for note in notes]),
    )


def _find_only(element: Element, tag: str, place: str, notes: list[str]) -> Element | None:
    found = element.findall(tag)
    if len(found) > 1:
        notes.append(f"{place} has {len(found)} <{tag}> elements; the first counts, as in ROS")
    return found[0] if found else None


def _read_origin(element: Element, place: str, notes: list[str], straighten: bool) -> Array:
    xyz, rpy = read_origin(_find_only(element, "origin", place, notes), place)
    if straighten:
        rpy = [
            straighten_angle(value, f"{name} of {place}", notes)
            for name, value in zip(("roll", "pitch", "yaw"), rpy, strict=True)
        ]
    return placement(rotation_from_rpy(rpy), xyz)


def _read_bodies(root: Element, source: str, notes: list[str], straighten: bool) -> _Bodies:
    bodies: _Bodies = {}
    for i, element in enumerate(root.findall("link")):
        name = require_attribute(element, "name", f"{source}, link number {i + 1}")
        if name in bodies:
            raise DescriptionError(
                f"{source}: two links are named {name!r}; every link needs its own name"
            )
        place = f"{source}, link {name!r}"
        inertial = _find_only(element, "inertial", place, notes)
        bodies[name] = (
            None if inertial is None else _read_inertia(inertial, place, notes, straighten)
        )
    if not bodies:
        raise DescriptionError(f"{source}: the URDF has no <link>")
    return bodies


def _read_inertia(inertial: Element, place: str, notes: list[str], straighten: bool) -> LinkInertia:
    place = f"{place}, inertial"
    mass = inertial.find("mass")
    tensor = inertial.find("inertia")
    if mass is None or tensor is None:
        missing = "mass" if mass is None else "inertia"
        raise DescriptionError(
            f"{place}: <{missing}> is missing; give <mass value=.../> and <inertia ixx=... .../>,"
            " or leave <inertial> out"
        )
    xx, yy, zz = (read_number(tensor, name, place) for name in ("ixx", "iyy", "izz"))
    xy, xz, yz = (read_number(tensor, name, place) for name in ("ixy", "ixz", "iyz"))
    about_com = LinkInertia.from_com(
        read_number(mass, "value", place), np.zeros(3), [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    )
    return about_com.moved(_read_origin(inertial, place, notes, straighten))


def _read_connections(
    root: Element, bodies: _Bodies, source: str, notes: list[str], straighten: bool
) -> list[_Connection]:
    connections: list[_Connection] = []
    names: set[str] = set()
    parent_joint: dict[str, str] = {}
    for i, element in enumerate(root.findall("joint")):
        name = require_attribute(element, "name", f"{source}, joint number {i + 1}")
        if name in names:
            raise DescriptionError(
                f"{source}: two joints are named {name!r}; every joint needs its own name"
            )
        names.add(name)
        place = f"{source}, joint {name!r}"
        kind = require_attribute(element, "type", place)
        if kind in HELD_OR_REPLACED:
            raise DescriptionError(
                f"{place}: type is {kind!r}; asbuilt describes robots whose root link stands still"
                " and whose joints are revolute, continuous, prismatic or fixed",
                cure=HELD_OR_REPLACED[kind],
            )
        if kind not in (*MOVING, "fixed"):
            raise DescriptionError(
                f"{place}: type is {kind!r}; it must be revolute, continuous, prismatic or fixed"
            )
        parent, child = (_read_end(element, end, bodies, place) for end in ("parent", "child"))
        if parent == child:
            raise DescriptionError(f"{place}: the joint connects link {parent!r} with itself")
        if child in parent_joint:
            raise DescriptionError(
                f"{source}: link {child!r} is the child of joint {parent_joint[child]!r} and of"
                f" joint {name!r}; closed chains are not supported, a link hangs on one joint"
            )
        parent_joint[child] = name
        connections.append(
            _Connection(
                name,
                kind,
                parent,
                child,
                _read_origin(element, place, notes, straighten),
                element,
                place,
            )
        )
    return connections


def _read_end(element: Element, end: str, bodies: _Bodies, place: str) -> str:
    found = element.find(end)
    if found is None:
        raise DescriptionError(f"{place}: <{end} link=...> is missing")
    name = require_attribute(found, "link", place)
    if name not in bodies:
        raise DescriptionError(
            f"{place}: the {end} link {name!r} does not exist{close_match(name, bodies)}"
        )
    return name


def _find_root_link(bodies: _Bodies, connections: list[_Connection], source: str) -> str:
    children = {connection.child for connection in connections}
    tops = [name for name in bodies if name not in children]
    if not tops:
        raise DescriptionError(
            f"{source}: every link is the child of a joint, so the joints form a loop; one link"
            " must be the root"
        )
    if len(tops) > 1:
        raise DescriptionError(
            f"{source}: {len(tops)} links have no parent joint"
            f" ({', '.join(repr(name) for name in tops[:5])}); a robot has one root: connect the"
            " others to it"
        )
    return tops[0]


def _merge_fixed(
    top: str,
    bodies: _Bodies,
    connections: list[_Connection],
    source: str,
    notes: list[str],
) -> _Tree:
    tree = _Tree()
    below: dict[str, list[_Connection]] = {}
    for connection in connections:
        below.setdefault(connection.parent, []).append(connection)
    reached = {top}
    waiting = [(connection, ROOT, np.eye(4)) for connection in reversed(below.get(top, []))]
    while waiting:
        connection, carrier, parent_pose = waiting.pop()
        pose = compose_placements(parent_pose, connection.origin)
        name = connection.child
        inertia = bodies[connection.child]
        reached.add(name)
        if connection.kind == "fixed":
            tree.frames.append(Frame(name=name, link=carrier, placement=pose))
            if carrier != ROOT and inertia is not None:
                tree.parts[carrier].append((name, inertia.moved(pose)))
        else:
            tree.joints.append(_make_joint(connection, carrier, pose, notes))
            tree.links.append(name)
            tree.parts.append([(name, inertia)] if inertia is not None else [])
            carrier = len(tree.joints) - 1
            pose = np.eye(4)
        waiting.extend((after, carrier, pose) for after in reversed(below.get(name, [])))
    if len(reached) < len(bodies):
        lost = next(name for name in bodies if name not in reached)
        raise DescriptionError(
            f"{source}: link {lost!r} cannot be reached from the root link {top!r}; its joints form"
            " a loop"
        )
    return tree


def _make_joint(connection: _Connection, parent: int, pose: Array, notes: list[str]) -> Joint:
    onto = rotation_onto(_read_axis(connection, notes))
    return Joint(
        name=connection.name,
        kind=MOVING[connection.kind],
        parent=parent,
        before=compose_placements(pose, placement(onto)),
        after=placement(onto.T),
        limits=_read_limits(connection, notes),
        drive=_read_drive(connection),
        mimic=_read_mimic(connection),
    )


def _read_mimic(connection: _Connection) -> Mimic | None:
    element = connection.element.find("mimic")
    place = connection.place
    if element is None:
        return None
    source = require_attribute(element, "joint", f"{place}, mimic")
    multiplier = read_number(element, "multiplier", place, 1.0)
    offset = read_number(element, "offset", place, 0.0)
    return Mimic.of(connection.name, source, multiplier, offset)


def _drop_fixed_mimics(
    joints: list[Joint], connections: list[_Connection], notes: list[str]
) -> None:
    """Let joints that follow a fixed one, which stands still, have a motor."""
    fixed = {connection.name for connection in connections if connection.kind == "fixed"}
    for k, joint in enumerate(joints):
        if joint.mimic is not None and not fixed.isdisjoint(joint.mimic.factors):
            joints[k] = replace(joint, mimic=None)
            notes.append(
                f"joint {joint.name!r}: the joint mimics a fixed joint; <mimic> is left out"
            )


def _read_axis(connection: _Connection, notes: list[str]) -> Array:
    element = connection.element.find("axis")
    given = np.array(
        [1.0, 0.0, 0.0] if element is None else read_numbers(element, "xyz", 3, connection.place)
    )
    length = float(np.linalg.norm(given))
    if length == 0.0:
        raise DescriptionError(
            f"{connection.place}: the axis is {given.tolist()} and has no direction; give a unit"
            ' vector such as xyz="0 0 1"'
        )
    if abs(length - 1.0) > AXIS_TOLERANCE:
        notes.append(
            f"{connection.place}: the axis {given.tolist()} has length {length:.6g} {SCALED}"
        )
    return given / length


def _read_limits(connection: _Connection, notes: list[str]) -> JointLimits:
    element = connection.element.find("limit")
    place = connection.place
    if element is None:
        return JointLimits()
    lower = read_number(element, "lower", place, -np.inf)
    upper = read_number(element, "upper", place, np.inf)
    if connection.kind == "continuous":
        lower = -np.inf
        upper = np.inf
    zero = []
    if lower == upper == 0.0:
        # Exporters of CAD programs write zeros for what nobody stated.
        zero.append("position")
        lower = -np.inf
        upper = np.inf
    if lower > upper:
        raise DescriptionError(
            f"{place}: lower limit {lower} exceeds upper limit {upper}; swap them"
        )
    bounds = {}
    for attribute in ("velocity", "effort"):
        value = read_number(element, attribute, place, np.inf)
        if value < 0.0:
            raise DescriptionError(f"{place}: {attribute} limit is {value}; it must be positive")
        if value == 0.0:
            zero.append(attribute)
            value = np.inf
        bounds[attribute] = value
    if zero:
        notes.append(f"{place}: limits of {join_names(zero)} are 0, taken as not stated")
    return JointLimits(
        lower=lower, upper=upper, velocity=bounds["velocity"], torque=bounds["effort"]
    )


def _fix_floating_joints(root: Element) -> list[str]:
    """Make floating joints fixed, and return their names."""
    floating = [each for each in root.findall("joint") if each.get("type") == "floating"]
    for each in floating:
        each.set("type", "fixed")
    return [each.get("name", "") for each in floating]


def _read_drive(connection: _Connection) -> DriveValues:
    element = connection.element.find("dynamics")
    place = connection.place
    if element is None:
        return DriveValues()
    given = {
        name: read_number(element, name, place)
        for name in ("damping", "friction")
        if element.get(name) is not None
    }
    for name, value in given.items():
        if value < 0.0:
            raise DescriptionError(f"{place}: {name} is {value}; it must not be negative")
    return DriveValues(viscous=given.get("damping"), coulomb=given.get("friction"))


def _add_transmissions(joints: list[Joint], root: Element, source: str, notes: list[str]) -> None:
    """Give joints the armature `I n^2` of rotor inertia I and ratio n of their transmissions."""
    places = {joint.name: k for k, joint in enumerate(joints)}
    for element in root.findall("transmission"):
        named = [each.get("name", "").strip() for each in element.findall("joint")]
        actuators = element.findall("actuator")
        place = f"{source}, transmission of joint {', '.join(named)}"
        inertia = _read_motor_value(element, ROTOR_INERTIAS, place)
        if inertia is None:
            continue
        ratio = _read_motor_value(element, RATIOS, place)
        if len(named) != 1 or len(actuators) != 1 or named[0] not in places:
            notes.append(
                f"{place}: a rotor inertia of {inertia:g} kg m^2 is left out, since it belongs to"
                " no single moving joint"
            )
            continue
        n = 1.0 if ratio is None else ratio
        k = places[named[0]]
        drive = replace(joints[k].drive, armature=inertia * n**2, gear_ratio=abs(n))
        joints[k] = replace(joints[k], drive=drive)
        notes.append(
            f"{place}: rotor inertia {inertia:g} kg m^2 and ratio {n:g} make the armature"
            f" {inertia * n**2:.4g} kg m^2"
        )


ROTOR_INERTIAS = ("motorInertia", "rotor_inertia")
"""Elements for the inertia of a rotor [kg m^2], of ROS and of Drake."""
RATIOS = ("mechanicalReduction", "gear_ratio")
"""Elements for the ratio of a transmission, of ROS and of Drake."""


def _read_motor_value(transmission: Element, names: tuple[str, ...], place: str) -> float | None:
    """Return a value of a transmission as text or as attribute, None where it is not there.

    Raises `DescriptionError` for one that is no number, or no positive one.
    """
    for element in transmission.iter():
        if element.tag in names:
            text = element.get("value") or element.text or ""
            value = parse_finite_number(text.strip(), f"{place}: <{element.tag}>")
            if value == 0.0 or (value < 0.0 and "nertia" in element.tag):
                raise DescriptionError(f"{place}: <{element.tag}> is {value:g}; it is positive")
            return value
    return None


DESCRIPTION_FORMATS.register(
    "urdf",
    DescriptionFormat(
        "URDF",
        (".urdf", ".xml"),
        read_urdf,
        lambda content: find_outermost_tag(content) == "robot",
        on_bases=True,
    ),
)
