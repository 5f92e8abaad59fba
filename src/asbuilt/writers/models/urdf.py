"""A robot as a URDF without shapes, for robots that were not read from a URDF."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import format_numbers
from asbuilt.description import ROOT, Joint, Link, LinkInertia, Mimic, RobotModel
from asbuilt.description.rotation import (
    compose_placements,
    invert_placement,
    rpy_from_rotation,
)
from asbuilt.dynamics.kinematics import draw_postures
from asbuilt.errors import DescriptionError
from asbuilt.findings import Cure, join_names
from asbuilt.writers.models.physical import convert_to_plain_friction, refuse_inconsistent
from asbuilt.writers.models.urdf_edit import TENSOR, edit_urdf, note_urdf_limits
from asbuilt.writers.models.xml_spans import comment_text
from asbuilt.writing import atomic_write

PROPORTIONAL = 1e-9
"""Largest change of a share for which a passive joint counts as one that follows."""
UNLIMITED = 1e9
"""Value of a required limit that is unknown [rad, m, rad/s, m/s, N m or N]."""


def urdf_holds(key: str, numbers: Mapping[str, float]) -> bool:
    """Return whether URDF holds a drive term: viscous friction and any kind of dry friction."""
    return key in ("viscous", "coulomb", "asymmetric_coulomb", "smooth_coulomb")


def format_urdf(model: RobotModel) -> str:
    """Return the robot as a URDF in full precision, with what URDF cannot hold in comments.

    URDF has the joint axis through the origin of the link frame. If the model has the origin
    elsewhere (standard Denavit-Hartenberg parameters with a length a), the URDF link frame is the
    joint frame, the inertial is given in it, and a fixed link `<name>_frame` marks the frame of the
    model. Named frames become fixed links without mass.

    Raises
    ------
    InertiaError
        If the model is physically inconsistent.
    DescriptionError
        If a joint follows several others.
    """
    refuse_inconsistent(model)
    model = _adapt_to_urdf(model)
    root = Element("robot", name=model.name)
    root.extend(Comment(comment_text(note)) for note in (*model.notes, *note_urdf_limits(model)))
    # Names of added frames must not meet those of the robot.
    taken = {model.root_link, *model.link_names, *(frame.name for frame in model.frames)}
    SubElement(root, "link", name=model.root_link)
    moved = [_find_shift(joint) for joint in model.moving_joints]
    carriers = {
        ROOT: (model.root_link, np.eye(4)),
        # Frames in the model's links become frames in the URDF's.
        **dict(enumerate(zip(model.link_names, moved, strict=True))),
    }
    # Friction only: places and inertias are those of the model.
    joints = convert_to_plain_friction(model).moving_joints
    for joint, link, shift in zip(joints, model.links, moved, strict=True):
        _add_link(root, link, shift)
        parent, carried = carriers[joint.parent]
        # Parent's URDF frame to the parent's link, to the joint, to the link, back to this URDF
        # frame.
        place = compose_placements(carried, joint.before, joint.after, invert_placement(shift))
        _add_joint(root, joint, place, shift, parent, link.name)
        if not np.array_equal(shift, np.eye(4)):
            _add_fixed_link(root, _reserve_name(f"{link.name}_frame", taken), link.name, shift)
    for frame in model.frames:
        parent, carried = carriers[frame.link]
        _add_fixed_link(root, frame.name, parent, compose_placements(carried, frame.placement))
    _drop_base_joints(root, model)
    indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _drop_base_joints(root: Element, model: RobotModel) -> None:
    """Take the joints of a free base out, with the links between, so that it is the root link."""
    if not model.n_floating:
        return
    # The base's own link is the last of the chain: it stays, as the root.
    count = model.n_floating
    links = {model.root_link, *model.link_names[: count - 1]}
    # Frames marked on links that go would hang in the air.
    gone = {f"{name}_frame" for name in links}
    for element in [*root.findall("link"), *root.findall("joint")]:
        child = element.find("child")
        below = "" if child is None else child.get("link", "")
        base_joint = element.tag == "joint" and element.get("name") in model.joint_names[:count]
        if (
            base_joint
            or below in gone
            or (element.tag == "link" and element.get("name") in links | gone)
        ):
            root.remove(element)


def _adapt_to_urdf(model: RobotModel) -> RobotModel:
    """Return the robot with a joint for every coordinate, as URDF needs; refuse what it cannot."""
    # <mimic> follows joints only: motors that are none get rotors.
    model = _replace_loops(model).with_rotors
    for joint in model.followers:
        if joint.mimic is not None and len(joint.mimic.factors) > 1:
            raise DescriptionError(
                f"URDF cannot hold joint {joint.name!r} of {model.name}, which stands at"
                f" {joint.mimic}: <mimic> follows one joint",
                cure=Cure("write the robot file (.toml) or MJCF (.xml)"),
            )
    return model


def _replace_loops(model: RobotModel) -> RobotModel:
    """Return the robot with joints that follow in place of loops, where these have equal sides.

    Raises `DescriptionError` where passive joints do not move in proportion to motors.
    """
    if not model.loops:
        return model
    # One posture cannot tell proportion from coincidence.
    # Random postures between which shares are compared.
    q = draw_postures(model, np.random.default_rng(0), 20)
    moved = model.link_motion(q)
    # At the first posture, which all others agree with.
    n = model.n_joints
    G = moved.shares[0]
    joints = list(model.followers)
    for k, joint in enumerate(joints):
        if not joint.is_passive:
            continue
        # The share must be the same at all postures: only a straight line is a <mimic>.
        if np.ptp(moved.shares[:, n + k], axis=0).max() > PROPORTIONAL:
            raise DescriptionError(
                f"URDF has no loops, and joint {joint.name!r} of {model.name} does not move in"
                f" proportion to a motor ({join_names([str(loop) for loop in model.loops])})",
                cure=Cure("write the robot file (.toml) or MJCF (.xml)"),
                joint=joint.name,
            )
        shares = {
            name: round(float(share), 9)
            for name, share in zip(model.joint_names, G[n + k], strict=True)
            if abs(share) > PROPORTIONAL
        }
        # What is left of the position at the first posture.
        offset = float(moved.q[0, n + k]) - sum(
            share * q[0, model.joint_names.index(name)] for name, share in shares.items()
        )
        # Rounded to hide what Newton's method leaves.
        joints[k] = replace(joint, mimic=Mimic(shares, round(offset, 12)))
    return replace(model, followers=tuple(joints), loops=(), posture={})


def write_urdf(
    path: str | os.PathLike[str],
    model: RobotModel,
    *,
    original: str | Path | None = None,
    remarks: Sequence[str] = (),
) -> tuple[Path, tuple[str, ...]]:
    """Write `original` with the inertias and friction of the model, or else a new URDF.

    Comments hold the `remarks`.
    Returns the path and notes on what the file cannot hold; raises as `edit_urdf` and `format_urdf`
    do.
    """
    if original is None:
        commented = replace(model, notes=(*model.notes, *remarks))
        return atomic_write(path, format_urdf(commented)), note_urdf_limits(model)
    content, notes = edit_urdf(original, model, remarks)
    return atomic_write(path, content), notes


def _find_shift(joint: Joint) -> Array:
    """Return the pose of the model's link frame in the URDF's link frame."""
    # 1e-12: largest distance [m] of a link origin on the joint axis.
    # A prismatic joint has a direction and no axis: its frame may be anywhere.
    if not joint.is_revolute or np.abs(joint.after[:2, 3]).max() <= 1e-12:
        return np.eye(4)
    return np.array(joint.after)


def _add_link(root: Element, link: Link, shift: Array) -> None:
    element = SubElement(root, "link", name=link.name)
    inertia: LinkInertia = (
        link.inertia if np.array_equal(shift, np.eye(4)) else link.inertia.moved(shift)
    )
    # A link without mass has no <inertial>: parsers refuse a mass of zero.
    if not inertia.parameters.any():
        return
    inertial = SubElement(element, "inertial")
    tensor = inertia.inertia_about_com
    SubElement(inertial, "origin", xyz=format_numbers(inertia.com), rpy="0 0 0")
    SubElement(inertial, "mass", value=format_numbers([inertia.mass]))
    SubElement(
        inertial,
        "inertia",
        {name: format_numbers([tensor[place]]) for name, place in TENSOR.items()},
    )


def _add_joint(
    root: Element, joint: Joint, origin: Array, shift: Array, parent: str, child: str
) -> None:
    limits = joint.limits
    drive = joint.drive
    limited = (
        # A URDF has both limits of position or none.
        joint.kind != "continuous" and math.isfinite(limits.lower) and math.isfinite(limits.upper)
    )
    kind = "prismatic" if not joint.is_revolute else "revolute" if limited else "continuous"
    element = _connect_links(root, joint.name, kind, parent, child, origin)
    # z of the joint's frame in axes of the URDF's link: row 2 of that rotation.
    SubElement(element, "axis", xyz=format_numbers((joint.after @ invert_placement(shift))[2, :3]))
    bounds = (
        {}
        if kind == "continuous"
        else {"lower": _write_bound(limits.lower), "upper": _write_bound(limits.upper)}
    )
    if bounds or math.isfinite(limits.torque) or math.isfinite(limits.velocity):
        # Effort and velocity are both required, where a limit is written at all.
        SubElement(
            element,
            "limit",
            bounds
            | {"effort": _write_bound(limits.torque), "velocity": _write_bound(limits.velocity)},
        )
    if joint.mimic is not None:
        # `_adapt_to_urdf` has refused joints that follow several.
        ((other, factor),) = joint.mimic.factors.items()
        SubElement(
            element,
            "mimic",
            joint=other,
            multiplier=format_numbers([factor]),
            offset=format_numbers([joint.mimic.offset]),
        )
    given = {
        name: format_numbers([value])
        for name, value in (("damping", drive.viscous), ("friction", drive.coulomb))
        if value is not None
    }
    if given:
        SubElement(element, "dynamics", given)
    # None and zero alike lose nothing.
    silent = [
        f"{name} {value!r}" for name in ("armature", "offset") if (value := getattr(drive, name))
    ]
    if silent:
        element.append(Comment(f" {', '.join(silent)}: URDF has no place for it "))


def _add_fixed_link(root: Element, name: str, parent: str, pose: Array) -> None:
    SubElement(root, "link", name=name)
    _connect_links(root, f"{name}_fixed", "fixed", parent, name, pose)


def _connect_links(
    root: Element, name: str, kind: str, parent: str, child: str, pose: Array
) -> Element:
    """Add a joint between two links, its frame at `pose` in the parent's."""
    element = SubElement(root, "joint", name=name, type=kind)
    if not np.array_equal(pose, np.eye(4)):
        SubElement(
            element,
            "origin",
            xyz=format_numbers(pose[:3, 3]),
            rpy=format_numbers(rpy_from_rotation(pose[:3, :3])),
        )
    SubElement(element, "parent", link=parent)
    SubElement(element, "child", link=child)
    return element


def _reserve_name(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _write_bound(value: float) -> str:
    # URDF has no infinity.
    return repr(min(max(float(value), -UNLIMITED), UNLIMITED))
