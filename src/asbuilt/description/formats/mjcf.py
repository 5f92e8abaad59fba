"""Robots from MJCF (MuJoCo's XML), through MuJoCo's own compiler, without meshes or textures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.finite import LARGEST, parse_finite_number
from asbuilt.description.formats.compiled_mjcf import (
    Actuators,
    collect_warnings,
    couple_by_equalities,
    find_loops_by_equalities,
    insert_includes,
    with_passive_joints,
)
from asbuilt.description.formats.connected_links import Bodies, Connection, build_robot
from asbuilt.description.formats.description_format import DESCRIPTION_FORMATS, DescriptionFormat
from asbuilt.description.formats.xml import (
    TEXT,
    described_text,
    find_outermost_tag,
    parse_numbers,
    parse_xml,
)
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import (
    ROOT,
    DriveValues,
    Frame,
    Joint,
    JointKind,
    JointLimits,
    RobotModel,
)
from asbuilt.description.rotation import (
    compose_placements,
    condense_notes,
    placement,
    rotation_from_quaternion,
    rotation_onto,
    rotation_z,
    straighten_placement,
)
from asbuilt.description.structure.free_base import clear_base_inertias, free_mjcf
from asbuilt.description.structure.parts import BaseKind
from asbuilt.errors import DescriptionError, MissingExtraError
from asbuilt.findings import Cure

IRRELEVANT = (
    "asset",
    "contact",
    "deformable",
    "extension",
    "keyframe",
    "sensor",
    "size",
    "statistic",
    "visual",
    "custom",
)
"""Sections that say nothing about rigid bodies or that refer to files which need not be here."""

GENERATORS = ("attach", "composite", "flexcomp", "plugin", "replicate")

SHAPELESS = ("mesh", "hfield", "sdf")
FREE, BALL, SLIDE, HINGE = range(4)


def read_mjcf(
    path_or_text: str | Path, *, fixed_base: bool = False, base: BaseKind = "fixed"
) -> RobotModel:
    """Read a robot from an MJCF file or from the XML text itself; needs the extra `sim` (MuJoCo).

    MuJoCo compiles the file, so defaults, classes and orientations mean what they mean there;
    meshes and textures are taken out first. The frame of a link is the MuJoCo body frame. Bodies
    without joint are merged as fixed; several joints on one body become links in a row, all
    massless but the last. Armature, damping and frictionloss become drive values where they are
    not zero, as do the gains of position actuators and the constant torques of actuators; named
    sites become frames. A body whose inertia could only come from a mesh is marked as unknown, with
    a note.

    `fixed_base` holds free joints at the pose of their body; a free or planar `base` makes joints
    without a drive of the free joint. Raises `DescriptionError` for other
    free joints, for ball joints, included files and whatever MuJoCo refuses
    (format: MuJoCo XML reference).
    """
    content, source = described_text(path_or_text)
    root = parse_xml(content, source)
    if root.tag != "mujoco":
        raise DescriptionError(
            f"{source}: the outermost element is <{root.tag}>; an MJCF file has <mujoco model=...>"
        )
    insert_includes(root, source)
    try:
        import mujoco  # noqa: PLC0415 - an extra
    except ImportError:
        raise MissingExtraError("mujoco", "sim", "reading MJCF") from None
    if base != "fixed":
        free_mjcf(root, base, source)
    unknown = _remove_shapes(root, source)
    held = _remove_free_joints(root) if fixed_base else []
    compiled, warnings = _compile_model(mujoco, root, source)
    if not compiled.njnt:
        raise DescriptionError(
            f"{source}: no body has a hinge or slide joint, so there is nothing to identify"
        )
    reading = _Reading(compiled, Actuators(mujoco, compiled), source, unknown)
    notes = reading.notes
    notes.extend(f"MuJoCo warns: {warning}" for warning in warnings)
    notes.extend(f"the free joint of {body!r} is held at its pose" for body in held)
    for body in range(1, compiled.nbody):
        reading.add(body)
    tree = build_robot(
        root.get("model") or "robot", reading.bodies, reading.connections, source, []
    )
    frames = (*tree.frames, *reading.list_sites(tree))
    notes.extend(reading.actuators.notes())
    sprung = [
        joint.name
        for index, joint in enumerate(tree.joints)
        if np.any(compiled.jnt_stiffness[index])
    ]
    if sprung:
        notes.append(
            f"the springs of {', '.join(sprung)} (stiffness) are left out; identify them with the"
            " drive terms auto,spring:joints=..."
        )
    places = {
        body: ("world" if link == ROOT else tree.links[link].name, pose)
        for body in range(compiled.nbody)
        for link, pose in [tree.places[reading.names[body]]]
    }
    loops, closing = find_loops_by_equalities(mujoco, compiled, places, tree.joints)
    joints, left_out = couple_by_equalities(mujoco, compiled, tree.joints, closing)
    joints = with_passive_joints(mujoco, compiled, joints, tree.link_names, loops)
    rest = compiled.qpos0[compiled.jnt_qposadr] if loops else ()
    if left_out:
        notes.append(
            f"{left_out} equality constraints are left out; every joint counts as driven on its own"
        )
    links = [replace(link, inertia_known=link.name not in unknown) for link in tree.links]
    return replace(
        tree,
        joints=tuple(joints),
        loops=tuple(loops),
        posture={joint.name: float(q) for joint, q in zip(tree.joints, rest, strict=False)},
        links=clear_base_inertias(source, joints, links, base),
        gravity=np.array(compiled.opt.gravity),
        frames=frames,
        source="MJCF text" if source == TEXT else source,
        notes=condense_notes(notes),
    ).closed()


COMPILED = {
    "body": ("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    "joint": ("jnt_pos", "jnt_axis"),
    "site": ("site_pos", "site_quat"),
}
"""Arrays of a compiled model that become lengths, rotations and masses, by what has them."""


def _check_numbers(compiled: Any, source: str) -> None:
    """Raise `DescriptionError` with place and value for a number that no robot has."""
    for what, arrays in COMPILED.items():
        for array in arrays:
            values = np.asarray(getattr(compiled, array))
            wrong = np.argwhere(~(np.abs(values) <= LARGEST))  # NaN is in no range
            if wrong.size:
                name = getattr(compiled, what)(int(wrong[0, 0])).name or "world"
                raise DescriptionError(
                    f"{source}: {array.partition('_')[2]} of the {what} {name!r} is"
                    f" {values[tuple(wrong[0])]:g}; it must be a number of at most {LARGEST:g}"
                )


def _compile_model(mujoco: ModuleType, root: Element, source: str) -> tuple[Any, list[str]]:
    """Return the compiled model and MuJoCo's warnings."""
    try:
        with collect_warnings(mujoco) as warnings:
            compiled = mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))
    except RecursionError:
        raise DescriptionError(
            f"{source}: the elements are nested too deeply; MuJoCo allows about 500 bodies in a row"
        ) from None
    except ValueError as error:
        raise DescriptionError(
            f"{source}: MuJoCo refuses the model: {' '.join(str(error).split())}"
        ) from None
    unset = next((warning for warning in warnings if "NaN" in warning), None)
    if unset is not None:  # MuJoCo takes such a number for one that is not given
        raise DescriptionError(
            f"{source}: a number is not finite ({unset}); give it, or leave it out"
        )
    _check_numbers(compiled, source)
    return compiled, warnings


def _remove_shapes(root: Element, source: str) -> dict[str, float]:
    """Take out what needs files, and return the bodies whose inertia went with it.

    Each has the mass [kg] that its geoms state, 0 where they state none.
    """
    generated = next((element.tag for element in root.iter() if element.tag in GENERATORS), None)
    if generated is not None:
        raise DescriptionError(
            f"{source}: the model holds <{generated}>, which MuJoCo expands from other files or"
            " into soft bodies; write its rigid bodies out"
        )
    for section in IRRELEVANT:
        for element in root.findall(section):
            root.remove(element)
    defaults: dict[str | None, Mapping[str, str]] = {
        name: attributes
        for element in root.findall("default")
        for name, attributes in _list_default_geoms(element, {})
    }
    for element in root.iter():
        element.attrib.pop("material", None)
    compiler = root.find("compiler")
    from_geoms = False
    groups: tuple[float, ...] = (0.0, np.inf)
    if compiler is not None:
        compiler.attrib.pop("fusestatic", None)
        from_geoms = compiler.get("inertiafromgeom") == "true"
        if compiler.get("inertiagrouprange"):
            groups = tuple(parse_numbers(compiler.get("inertiagrouprange", ""), 2, source))
    unknown: dict[str, float] = {}
    waiting: list[tuple[Element, str | None]] = [
        (world, None) for world in root.findall("worldbody")
    ]
    while waiting:
        body, inherited = waiting.pop()
        inside = list(_list_inside(body, body.get("childclass", inherited)))
        waiting.extend(
            (element, childclass) for _, element, childclass in inside if element.tag == "body"
        )
        explicit = body.find("inertial") is not None and not from_geoms
        geoms = [
            (holder, element, {**defaults.get(element.get("class", kind), {}), **element.attrib})
            for holder, element, kind in inside
            if element.tag == "geom"
        ]
        needed = [
            attributes
            for _, _, attributes in geoms
            if _find_shape(attributes) in SHAPELESS and _has_mass(attributes, groups)
        ]
        lost = bool(needed) and not explicit
        for holder, geom, attributes in geoms:
            if explicit or lost or body.tag == "worldbody" or _find_shape(attributes) in SHAPELESS:
                holder.remove(geom)
        if lost and body.tag == "body":
            body.set("name", body.get("name") or f"unnamed_{len(unknown) + 1}")
            stated = [_read_number(attributes, "mass", 0.0) for _, _, attributes in geoms]
            unknown[body.get("name", "")] = sum(stated)
            if body.find("inertial") is None:
                body.insert(
                    0, Element("inertial", {"pos": "0 0 0", "mass": "1", "diaginertia": "1 1 1"})
                )
    for geom in (geom for default in root.iter("default") for geom in default.findall("geom")):
        if geom.attrib.pop("mesh", None) is not None or geom.get("type") in SHAPELESS:
            geom.attrib.pop("type", None)
    return unknown


def _remove_free_joints(root: Element) -> list[str]:
    """Take out the free joints, and return the names of their bodies."""
    held = []
    for body in root.iter("body"):
        for joint in [*body.findall("freejoint"), *body.findall("joint[@type='free']")]:
            body.remove(joint)
            held.append(body.get("name") or "a body")
    return held


def _list_inside(
    body: Element, childclass: str | None
) -> Iterator[tuple[Element, Element, str | None]]:
    """Yield holder, element and class in force for what belongs to a body.

    `<frame>` elements, which are no bodies, are passed through.
    """
    for element in body:
        if element.tag == "frame":
            yield from _list_inside(element, element.get("childclass", childclass))
        else:
            yield body, element, childclass


def _find_shape(attributes: Mapping[str, str]) -> str:
    """Return the type of a geom, by its attributes and those of its classes."""
    return "mesh" if "mesh" in attributes else attributes.get("type", "sphere")


def _has_mass(attributes: Mapping[str, str], groups: tuple[float, ...]) -> bool:
    """Return whether a geom counts for the inertia of its body, and is not there to be seen."""
    inside = groups[0] <= _read_number(attributes, "group", 0.0) <= groups[1]
    density = _read_number(attributes, "density", 1.0)
    return inside and _read_number(attributes, "mass", density) != 0.0


def _read_number(attributes: Mapping[str, str], name: str, usual: float) -> float:
    """Return the number of an attribute; MuJoCo refuses what is none."""
    with suppress(ValueError):
        return float(attributes.get(name, usual))
    return usual


def _list_default_geoms(
    element: Element, inherited: Mapping[str, str]
) -> list[tuple[str | None, Mapping[str, str]]]:
    """Return the attributes of geoms of each class, with those of the classes around it."""
    geom = element.find("geom")
    attributes = {**inherited, **({} if geom is None else geom.attrib)}
    name = element.get("class") or "main"
    own: list[tuple[str | None, Mapping[str, str]]] = [(name, attributes)]
    own += [(None, attributes)] if name == "main" else []
    return own + [
        entry
        for nested in element.findall("default")
        for entry in _list_default_geoms(nested, attributes)
    ]


@dataclass
class _Reading:
    """What grows while the bodies of a compiled model are read one after the other."""

    model: Any
    actuators: Actuators
    source: str
    unknown: Mapping[str, float]
    bodies: Bodies = field(default_factory=lambda: {"world": None})
    connections: list[Connection] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @cached_property
    def names(self) -> list[str]:
        """Names of the bodies, each its own, in which those without a name have their number."""
        given = [str(self.model.body(body).name) for body in range(self.model.nbody)]
        found = []
        for body, name in enumerate(given):
            usual = f"body_{body}"
            while not name and usual in given:
                usual += "_unnamed"
            found.append(name or usual)
        return found

    def add(self, body: int) -> None:
        """Add a body and what connects it; of several joints all but the last have a link alone."""
        m = self.model
        name = self.names[body]
        parent = self.names[m.body_parentid[body]]
        origin = self.placed(m.body_pos[body], m.body_quat[body], f"body {name!r}")
        first = int(m.body_jntadr[body])
        count = int(m.body_jntnum[body])
        for k in range(count):
            joint = self.joint(first + k, name)
            child = name if k == count - 1 else f"{name}_after_{joint.name}"
            self.connections.append(Connection(joint.name, parent, child, origin, joint))
            self.bodies[child] = None
            parent = child
            origin = np.eye(4)
        if count == 0:
            self.connections.append(Connection(name, parent, name, origin, None))
        self.bodies[name] = self.inertia(body, name)

    def inertia(self, body: int, name: str) -> LinkInertia | None:
        """Return the mass properties of a body in its frame, None where it has none or stands."""
        m = self.model
        if m.body_weldid[body] == 0:
            return None
        if name in self.unknown:
            mass = self.unknown[name]
            stated = f" ({mass:.4g} kg by its geoms)" if mass > 0.0 else ""
            self.notes.append(
                f"body {name!r} has no <inertial>, and its inertia{stated} would come from a mesh"
                " that is not read; it counts as not given"
            )
            return None
        if not m.body_mass[body] > 0.0:
            return None
        frame = placement(rotation_from_quaternion(m.body_iquat[body]), m.body_ipos[body])
        mass = parse_finite_number(f"{m.body_mass[body]:.17g}", f"body {name!r}: mass")
        body_inertia = LinkInertia.from_com(mass, np.zeros(3), np.diag(m.body_inertia[body]))
        return body_inertia.moved(frame)

    def joint(self, index: int, body: str) -> Joint:
        m = self.model
        name = m.joint(index).name or f"joint_{index}"
        kind = int(m.jnt_type[index])
        if kind in (FREE, BALL):
            what = "free" if kind == FREE else "ball"
            raise DescriptionError(
                f"{self.source}: joint {name!r} of body {body!r} is a {what} joint; asbuilt"
                " describes robots on a fixed root with hinge and slide joints",
                cure=(
                    Cure(
                        "hold it at its pose if the robot hangs in the air or stands clamped, or"
                        " remove it",
                        settings={"fixed_base": True},
                    )
                    if kind == FREE
                    else Cure("remove it, or replace it by hinges")
                ),
            )
        onto = rotation_onto(m.jnt_axis[index])
        anchor = np.array(m.jnt_pos[index])
        at_rest = float(m.qpos0[m.jnt_qposadr[index]])
        back = (
            placement(rotation_z(-at_rest))
            if kind == HINGE
            else placement(translation=(0.0, 0.0, -at_rest))
        )
        return Joint(
            name=name,
            kind=self.kind(index),
            parent=ROOT,
            before=compose_placements(placement(onto, anchor), back),
            after=compose_placements(placement(onto.T), placement(translation=-anchor)),
            limits=self.limits(index),
            drive=self.drive(int(m.jnt_dofadr[index]), index),
        )

    def kind(self, index: int) -> JointKind:
        if int(self.model.jnt_type[index]) == SLIDE:
            return "prismatic"
        return "revolute" if self.model.jnt_limited[index] else "continuous"

    def limits(self, index: int) -> JointLimits:
        m = self.model
        lower, upper = (
            (float(bound) for bound in m.jnt_range[index])
            if m.jnt_limited[index]
            else (-np.inf, np.inf)
        )
        torque = (
            float(np.abs(m.jnt_actfrcrange[index]).max()) if m.jnt_actfrclimited[index] else np.inf
        )
        torque = min(torque, self.actuators.torque_limit(index))
        return JointLimits(lower=lower, upper=upper, torque=torque)

    def drive(self, coordinate: int, index: int) -> DriveValues:
        m = self.model
        armature, viscous, coulomb = (
            float(np.ravel(array[coordinate])[0])
            for array in (m.dof_armature, m.dof_damping, m.dof_frictionloss)
        )
        armature += self.actuators.own(index, "armature")
        viscous += self.actuators.own(index, "damping")
        kp, kd = self.actuators.gains(index)
        return DriveValues(
            # What is zero is not stated.
            armature=armature or None,
            viscous=viscous or None,
            coulomb=coulomb or None,
            offset=self.actuators.offset(index),
            kp=kp,
            kd=kd,
        )

    def placed(self, position: Array, quaternion: Array, what: str) -> Array:
        pose = placement(rotation_from_quaternion(quaternion), position)
        return straighten_placement(pose, what, self.notes)

    def list_sites(self, tree: RobotModel) -> Iterator[Frame]:
        """Yield the sites that have a name of their own as frames."""
        m = self.model
        taken = {*tree.link_names, *(frame.name for frame in tree.frames)}
        for site in range(m.nsite):
            name = m.site(site).name
            if name and name not in taken:
                link, pose = tree.places[self.names[m.site_bodyid[site]]]
                own = self.placed(m.site_pos[site], m.site_quat[site], f"site {name!r}")
                yield Frame(name, link, compose_placements(pose, own))


DESCRIPTION_FORMATS.register(
    "mjcf",
    DescriptionFormat(
        "MJCF",
        (".mjcf", ".xml"),
        read_mjcf,
        lambda content: find_outermost_tag(content) == "mujoco",
        on_bases=True,
    ),
)
