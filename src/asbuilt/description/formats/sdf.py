"""Robots from SDF (Simulation Description Format).

SDF states poses in the frame of the model or in any named frame, not from joint to joint as URDF
does, and the frame of a joint need not be that of its link (format: http://sdformat.org/spec).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
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
    close_match,
    described_text,
    find_outermost_tag,
    parse_numbers,
    parse_xml,
)
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import Loop, Mimic, RobotModel
from asbuilt.description.rotation import (
    compose_placements,
    invert_placement,
    placement,
    rotation_from_rpy,
    straighten_placement,
)
from asbuilt.errors import DescriptionError

MODEL = "__model__"
"""Name that SDF gives to the frame of a model."""
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
MOST_NAMED = 8
"""Frames of a circle that an error names."""
HINGE = 0.1
"""Distance of the two points [m] by which a hinge closes a loop."""
UNLIMITED = 1e15
"""Limits from here on are SDF's way to state none."""


@dataclass
class _Frames:
    """Find where the frames of a model are: each in the frame that it is attached to.

    `carriers` names what each frame is attached to, and the world the root.
    """

    source: str
    stated: dict[str, tuple[str, Array]] = field(default_factory=dict)
    found: dict[str, Array] = field(default_factory=lambda: {MODEL: np.eye(4)})
    carriers: dict[str, str] = field(default_factory=dict)

    def link(self, name: str) -> str:
        """Return the link that carries a link or a frame; MODEL for the world."""
        seen = list[str]()
        while name in self.carriers and name not in seen:
            seen.append(name)
            name = self.carriers[name]
        if name in seen:
            raise DescriptionError(
                f"{self.source}: the frames {', '.join(seen[:MOST_NAMED])} are attached to each"
                " other in a circle"
            )
        return name

    def relative(self, origin: str, name: str) -> Array:
        """Return the pose (4, 4) of a frame in another."""
        return compose_placements(invert_placement(self.pose(origin)), self.pose(name))

    def pose(self, name: str) -> Array:
        """Return the pose (4, 4) of a frame in the frame of the model."""
        chain: dict[str, None] = {}  # in order, from the frame to one whose pose is found
        origin = name
        while origin not in self.found:
            if origin in chain:
                circle = [*chain][[*chain].index(origin) :]
                raise DescriptionError(
                    f"{self.source}: the poses of {', '.join(circle[:MOST_NAMED])}"
                    f"{' ...' * (len(circle) > MOST_NAMED)} refer to each other in a circle"
                )
            if origin not in self.stated:
                raise DescriptionError(
                    f"{self.source}: there is no link, joint or frame"
                    f" {origin!r}{close_match(origin, self.stated)}"
                )
            chain[origin] = None
            origin = self.stated[origin][0]
        for each in reversed(chain):
            before, pose = self.stated[each]
            self.found[each] = compose_placements(self.found[before], pose)
        return self.found[name]


def read_sdf(path_or_text: str | Path | bytes) -> RobotModel:
    """Read a robot from an SDF file or from the XML text itself.

    One model is read, by itself or in a world; included and nested models are refused. Gravity is
    the world's, else the Earth's.

    Raises
    ------
    DescriptionError
        Naming the element, what was given and what would do.
    """
    content, source = described_text(path_or_text)
    root = parse_xml(content, source)
    if root.tag != "sdf":
        raise DescriptionError(f"{source}: the outermost element is <{root.tag}>, expected <sdf>")
    model = _find_only_model(root, source)
    frames = _read_frames(model, source)
    closing = _find_closing_joints(model, frames, source)
    notes: list[str] = []
    bodies: Bodies = {MODEL: None}
    for link in model.findall("link"):
        bodies[str(link.get("name"))] = _read_body(link, frames, source, notes)
    connections = [
        _read_joint(joint, frames, source, notes)
        for joint in model.findall("joint")
        if joint not in closing
    ]
    children = {MODEL, *(connection.child for connection in connections)}
    connections[:0] = [
        Connection(name, MODEL, name, straighten_placement(pose, f"link {name!r}", notes), None)
        for name, pose in ((name, frames.pose(name)) for name in bodies if name not in children)
    ]
    name = str(model.get("name") or "robot").strip()
    robot = build_robot(name, bodies, connections, source, notes)
    gravity = root.find("world/gravity")
    turned = np.eye(3) if model.find("pose") is None else _read_pose(model, source)[:3, :3]
    free_fall = (
        np.asarray(robot.gravity)
        if gravity is None
        else np.array(parse_numbers(gravity.text or "", 3, f"{source}: <gravity>"))
    )
    loops = _read_loops(closing, frames, source)
    said = (*robot.notes, *_note_unread(model))
    return replace(robot, gravity=turned.T @ free_fall, loops=loops, notes=said).closed()


UNREAD = {
    "spring_stiffness": "springs of joints",
    "fluid_added_mass": "added mass of fluids",
    "axis2": "second axes of joints",
    "gearbox_ratio": "gearboxes between joints",
    "thread_pitch": "pitches of screws",
    "static": "that the model is static",
}
"""Elements of SDF with a meaning for dynamics that are not read."""


def _note_unread(model: Element) -> tuple[str, ...]:
    """Return notes on elements that change the dynamics and are not read."""
    zero = ("", "0", "false")
    there = {
        what
        for tag, what in UNREAD.items()
        for each in model.iter(tag)
        if len(each) or (each.text or "").strip().rstrip(".0") not in zero
    }
    computed = any(each.get("auto") in ("true", "1") for each in model.iter("inertial"))
    there |= {"inertias computed from shapes (auto)"} if computed else set()
    return tuple(f"not read of SDF: {what}" for what in sorted(there))


def _find_closing_joints(model: Element, frames: _Frames, source: str) -> list[Element]:
    """Return the joints to links that another joint before them moves already: they close loops."""
    moved = set[str]()
    closing = list[Element]()
    for joint in model.findall("joint"):
        child = frames.link(_read_text(joint, "child", source))
        if child in moved:
            closing.append(joint)
        moved.add(child)
    return closing


def _read_loops(joints: Sequence[Element], frames: _Frames, source: str) -> tuple[Loop, ...]:
    """Return joints as loops that are closed where all joints are at zero.

    A hinge is two points on its axis.
    """
    loops = []
    for joint in joints:
        name = str(joint.get("name"))
        kind = joint.get("type")
        place = f"{source}, joint {name!r}"
        links = [frames.link(_read_text(joint, side, place)) for side in ("parent", "child")]
        at = frames.pose(name)
        inside = [compose_placements(invert_placement(frames.pose(link)), at) for link in links]
        if kind == "fixed":
            turned = compose_placements(inside[0], invert_placement(inside[1]))[:3, :3]
            one, other = (each[:3, 3] for each in inside)
            loops.append(Loop("weld", links[0], one, links[1], other, turned, name=name))
            continue
        if kind not in ("revolute", "continuous", "ball"):
            raise DescriptionError(
                f"{place}: it closes a loop, for another joint moves link {links[1]!r} too; such a"
                f" joint may be revolute, continuous, ball or fixed, not {kind!r}; put it before"
                " the other one in the file"
            )
        axis = joint.find("axis")
        points = [np.zeros(3)]
        if kind != "ball" and axis is not None:
            points.append(HINGE * _read_direction(axis, frames, name, place))
        for point in points:
            one, other = (each[:3, :3] @ point + each[:3, 3] for each in inside)
            loops.append(Loop("connect", links[0], one, links[1], other, name=name))
    return tuple(loops)


def _find_only_model(root: Element, source: str) -> Element:
    models = [*root.findall("model"), *root.findall("world/model")]
    if len(models) != 1:
        names = ", ".join(str(model.get("name")) for model in models)
        raise DescriptionError(
            f"{source}: it has {len(models)} models{f' ({names})' if names else ''}; keep the robot"
            " alone"
        )
    (model,) = models
    for tag in ("include", "model"):
        if model.find(tag) is not None:
            raise DescriptionError(
                f"{source}: model {model.get('name')!r} has <{tag}>, which is not read; write all"
                " links and joints into one model, as  gz sdf -p FILE  does"
            )
    return model


def _read_frames(model: Element, source: str) -> _Frames:
    frames = _Frames(source, {"world": (MODEL, np.eye(4))}, carriers={"world": MODEL})
    first = model.find("link")
    # The frame of a model is attached to its first link, unless another is named.
    canonical = model.get("canonical_link") or (None if first is None else first.get("name"))
    for tag, usual in (("link", MODEL), ("frame", MODEL), ("joint", "")):
        for element in model.findall(tag):
            name = element.get("name")
            if not name or name in {*frames.stated, MODEL}:
                raise DescriptionError(f"{source}: a <{tag}> has no name of its own ({name!r})")
            origin = usual or _read_text(element, "child", source)
            origin = element.get("attached_to") or origin
            pose = element.find("pose")
            relative = None if pose is None else pose.get("relative_to")
            if tag == "frame":
                attached = element.get("attached_to") or canonical or MODEL
                frames.carriers[name] = canonical if attached == MODEL and canonical else attached
            frames.stated[name] = (relative or origin, _read_pose(element, f"{source}, {name}"))
    return frames


def _read_body(link: Element, frames: _Frames, source: str, notes: list[str]) -> LinkInertia | None:
    """Return the mass properties of a link, None where it states none."""
    name = str(link.get("name"))
    inertial = link.find("inertial")
    if inertial is None:
        return None
    place = f"{source}, link {name!r}, inertial"
    pose = _read_pose(inertial, place)
    at = inertial.find("pose")
    relative = None if at is None else at.get("relative_to")
    if relative:
        pose = compose_placements(frames.relative(name, relative), pose)
    tensor = inertial.find("inertia")
    xx, xy, xz, yy, yz, zz = (
        _read_number(tensor, key, place, float(key[1] == key[2])) for key in INERTIA
    )
    body = LinkInertia.from_com(
        _read_number(inertial, "mass", place, 1.0),
        np.zeros(3),
        [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
    )
    return body.moved(straighten_placement(pose, place, notes))


def _read_joint(joint: Element, frames: _Frames, source: str, notes: list[str]) -> Connection:
    name = str(joint.get("name"))
    kind = str(joint.get("type"))
    place = f"{source}, joint {name!r}"
    if kind not in (*MOVING, "fixed"):
        raise DescriptionError(
            f"{place}: type {kind!r} is not one of {', '.join((*MOVING, 'fixed'))}"
        )
    parent, child = (frames.link(_read_text(joint, end, place)) for end in ("parent", "child"))
    if kind == "fixed":
        origin = straighten_placement(frames.relative(parent, child), place, notes)
        return Connection(name, parent, child, origin, None)
    axis = joint.find("axis")
    if axis is None:
        raise DescriptionError(f"{place}: a {kind} joint needs <axis>")
    bounds = _read_bounds(axis.find("limit"), place)
    if kind == "revolute" and bounds.keys().isdisjoint(("lower", "upper")):
        kind = "continuous"
    dynamics = axis.find("dynamics")
    given = ("damping", "friction") if dynamics is not None else ()
    moving = make_joint(
        name,
        MOVING[kind],
        scale_axis(_read_direction(axis, frames, name, place).tolist(), place, notes),
        after=straighten_placement(frames.relative(name, child), f"the link of {place}", notes),
        limits=bound_joint(MOVING[kind], bounds, place, notes),
        drive=describe_drive(
            {key: _read_number(dynamics, key, place, 0.0) for key in given}, place
        ),
        mimic=_read_mimic(axis.find("mimic"), name, place),
    )
    origin = straighten_placement(frames.relative(parent, name), place, notes)
    return Connection(name, parent, child, origin, moving)


def _read_bounds(limit: Element | None, place: str) -> dict[str, float]:
    """Return the limits that a joint has."""
    bounds = {}
    for key in ("lower", "upper", "effort", "velocity"):
        value = None if limit is None else limit.find(key)
        number = None if value is None else _parse_limit(value.text, f"{place}: <{key}>")
        if number is not None and not (key in ("effort", "velocity") and number < 0.0):
            bounds[key] = number
    return bounds


def _read_direction(axis: Element, frames: _Frames, name: str, place: str) -> Array:
    """Return the axis of a joint in its own frame."""
    xyz = axis.find("xyz")
    direction = np.array([0.0, 0.0, 1.0])
    if xyz is not None:
        direction = np.array(parse_numbers(xyz.text or "", 3, f"{place}: <xyz>"))
        frame = xyz.get("expressed_in")
        if frame or _read_text(axis, "use_parent_model_frame", place, "false") in ("true", "1"):
            turned = frames.pose(name)[:3, :3].T @ frames.pose(frame or MODEL)[:3, :3]
            direction = turned @ direction
    return direction


def _read_mimic(mimic: Element | None, joint: str, place: str) -> Mimic | None:
    """Return what a joint follows, by SDF 1.11 at `multiplier (leader - reference) + offset`."""
    if mimic is None:
        return None
    leader = mimic.get("joint")
    if not leader:
        raise DescriptionError(f"{place}: <mimic> names no joint; give joint = the one it follows")
    multiplier, offset, reference = (
        _read_number(mimic, key, f"{place}, mimic", usual)
        for key, usual in (("multiplier", 1.0), ("offset", 0.0), ("reference", 0.0))
    )
    return Mimic.of(joint, leader, multiplier, offset - multiplier * reference)


def _parse_limit(text: str | None, what: str) -> float | None:
    """Return a limit, None where SDF states that there is none."""
    with suppress(ValueError):
        if abs(float(text or "")) >= UNLIMITED:
            return None
    return parse_finite_number((text or "").strip(), what)


def _read_pose(element: Element, place: str) -> Array:
    pose = element.find("pose")
    if pose is None or not (pose.text or "").strip():
        return np.eye(4)
    if pose.get("rotation_format") not in (None, "euler_rpy"):
        raise DescriptionError(f"{place}: the rotation of <pose> must be given as euler_rpy")
    values = parse_numbers(pose.text or "", 6, f"{place}: <pose>")
    angles = np.deg2rad(values[3:]) if pose.get("degrees") in ("true", "1") else values[3:]
    return placement(rotation_from_rpy(angles), values[:3])


def _read_text(element: Element, tag: str, place: str, default: str | None = None) -> str:
    found = element.find(tag)
    text = (found.text or "").strip() if found is not None else ""
    if not text:
        if default is None:
            raise DescriptionError(
                f"{place}: <{element.tag} name={element.get('name')!r}> has no <{tag}>"
            )
        return default
    return text


def _read_number(element: Element | None, tag: str, place: str, default: float) -> float:
    """Return the number of an element in another, the default where it is not there."""
    text = "" if element is None else (element.findtext(tag) or "").strip()
    return parse_finite_number(text, f"{place}: <{tag}>") if text else default


DESCRIPTION_FORMATS.register(
    "sdf",
    DescriptionFormat(
        "SDF",
        (".sdf", ".world", ".xml"),
        read_sdf,
        lambda content: find_outermost_tag(content) == "sdf",
    ),
)
