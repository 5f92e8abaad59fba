"""Robots from URDF (Unified Robot Description Format), without their meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast
from xml.etree.ElementTree import Element

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.finite import parse_finite_number
from asbuilt.description.formats.connected_links import (
    MOVING,
    Bodies,
    Connection,
    bound_joint,
    build_robot,
    describe_drive,
    make_joint,
    scale_axis,
)
from asbuilt.description.formats.description_format import DESCRIPTION_FORMATS, DescriptionFormat
from asbuilt.description.formats.xml import (
    TEXT,
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
    Joint,
    JointKind,
    Mimic,
    RobotModel,
)
from asbuilt.description.rotation import (
    placement,
    rotation_from_rpy,
    straighten_angle,
)
from asbuilt.description.structure.free_base import clear_base_inertias, free_urdf
from asbuilt.description.structure.parts import BaseKind
from asbuilt.errors import DescriptionError
from asbuilt.findings import Cure

HELD_OR_REPLACED = {
    "floating": Cure(
        "hold it at its pose if the robot hangs in the air or stands clamped, or replace it by"
        ' type="fixed"',
        settings={"fixed_base": True},
    ),
    "planar": Cure('replace it by type="fixed" or by a chain of those'),
}
"""What to do with joints of several freedoms, by type."""


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
    notes: list[str] = []
    if fixed_base:
        _fix_floating_joints(root, notes)
    if base != "fixed":
        free_urdf(root, base, source)
    bodies = _read_bodies(root, source, notes, straighten)
    connections = _read_connections(root, source, notes, straighten)
    _add_transmissions(connections, root, source, notes)
    name = (root.get("name") or "robot").strip()
    robot = build_robot(name, bodies, connections, source, notes)
    links = clear_base_inertias(source, robot.moving_joints, robot.links, base)
    return replace(robot, links=links, source="URDF text" if source == TEXT else source)


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


def _read_bodies(root: Element, source: str, notes: list[str], straighten: bool) -> Bodies:
    bodies: Bodies = {}
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
    root: Element, source: str, notes: list[str], straighten: bool
) -> list[Connection]:
    connections: list[Connection] = []
    names: set[str] = set()
    parent_joint: dict[str, str] = {}
    said: list[str] = []
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
        parent, child = (_read_end(element, end, place) for end in ("parent", "child"))
        if child in parent_joint:
            raise DescriptionError(
                f"{source}: link {child!r} is the child of joint {parent_joint[child]!r} and of"
                f" joint {name!r}; closed chains are not supported, a link hangs on one joint"
            )
        parent_joint[child] = name
        origin = _read_origin(element, place, notes, straighten)
        joint = None if kind == "fixed" else _read_joint(element, name, MOVING[kind], place, said)
        connections.append(Connection(name, parent, child, origin, joint))
    notes += said
    return connections


def _read_end(element: Element, end: str, place: str) -> str:
    found = element.find(end)
    if found is None:
        raise DescriptionError(f"{place}: <{end} link=...> is missing")
    return require_attribute(found, "link", place)


def _read_joint(
    element: Element, name: str, kind: JointKind, place: str, notes: list[str]
) -> Joint:
    axis = element.find("axis")
    given = [1.0, 0.0, 0.0] if axis is None else read_numbers(axis, "xyz", 3, place)
    limits = _read_given(element.find("limit"), ("lower", "upper", "velocity", "effort"), place)
    drive = _read_given(element.find("dynamics"), ("damping", "friction"), place)
    return make_joint(
        name,
        kind,
        scale_axis(given, place, notes),
        limits=bound_joint(kind, limits, place, notes),
        drive=describe_drive(drive, place),
        mimic=_read_mimic(element.find("mimic"), name, place),
    )


def _read_given(element: Element | None, names: Sequence[str], place: str) -> dict[str, float]:
    """Return the numbers of an element by the names of the attributes that it has."""
    if element is None:
        return {}
    return {
        name: read_number(element, name, place) for name in names if element.get(name) is not None
    }


def _read_mimic(element: Element | None, joint: str, place: str) -> Mimic | None:
    if element is None:
        return None
    source = require_attribute(element, "joint", f"{place}, mimic")
    multiplier = read_number(element, "multiplier", place, 1.0)
    return Mimic.of(joint, source, multiplier, read_number(element, "offset", place, 0.0))


def _fix_floating_joints(root: Element, notes: list[str]) -> None:
    """Make floating joints fixed."""
    for joint in root.findall("joint[@type='floating']"):
        joint.set("type", "fixed")
        notes.append(f"the floating joint {joint.get('name', '')!r} is held at its origin")


def _add_transmissions(
    connections: list[Connection], root: Element, source: str, notes: list[str]
) -> None:
    """Give joints the armature `I n^2` of rotor inertia I and ratio n of their transmissions."""
    moving = {connection.name: k for k, connection in enumerate(connections) if connection.joint}
    for element in root.findall("transmission"):
        named = [each.get("name", "").strip() for each in element.findall("joint")]
        actuators = element.findall("actuator")
        place = f"{source}, transmission of joint {', '.join(named)}"
        inertia = _read_motor_value(element, ROTOR_INERTIAS, place)
        if inertia is None:
            continue
        ratio = _read_motor_value(element, RATIOS, place)
        if len(named) != 1 or len(actuators) != 1 or named[0] not in moving:
            notes.append(
                f"{place}: a rotor inertia of {inertia:g} kg m^2 is left out, since it belongs to"
                " no single moving joint"
            )
            continue
        n = 1.0 if ratio is None else ratio
        k = moving[named[0]]
        joint = cast(Joint, connections[k].joint)
        drive = replace(joint.drive, armature=inertia * n**2, gear_ratio=abs(n))
        connections[k] = replace(connections[k], joint=replace(joint, drive=drive))
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
