"""The user's own URDF with the inertials and joint dynamics as built, and every other byte as it
was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.formats.xml import described_text
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import USUAL_GRAVITY, RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import DescriptionError
from asbuilt.writers.models.physical import in_plain_friction, left_out_drives, refuse_impossible
from asbuilt.writers.models.sample_states import sample_states
from asbuilt.writers.models.xml_spans import Edit, Span, XmlFile, attribute_edits

SAME_PLACE = 1e-9
"""Entries of placements [m, 1] may differ by this much in two descriptions of one robot."""
NOTABLE = 1e-9
"""A difference of torques [N m or N] beyond this is worth a note."""

_TENSOR = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


@dataclass(frozen=True, slots=True, eq=False)
class EditedUrdf:
    """Hold the edited file: `content` in the encoding of the original, and `notes` on what a reader
    must know.

    `links` and `joints` name what was changed, `emptied` the links behind fixed joints whose
    inertia went to the link that carries them. `reread_difference` (n,) is the largest torque
    difference between the model and the file as asbuilt reads it, `literal_difference` (n,) as a
    program reads it that takes rounded right angles (1.5708) to the letter [N m or N], over random
    motions.
    """

    content: bytes
    links: tuple[str, ...]
    joints: tuple[str, ...]
    emptied: tuple[str, ...]
    reread_difference: Array
    literal_difference: Array
    notes: tuple[str, ...]


def edited_urdf(original: str | Path | bytes, model: RobotModel) -> EditedUrdf:
    """Put the inertias and the viscous and Coulomb friction of `model` into a URDF of the same
    robot and keep all other bytes.

    The identified inertia of a moving link is that of everything fixed to it. Links behind fixed
    joints keep their inertials and the moving link gets the remainder, where that is a possible
    body; else the moving link gets the whole and theirs are removed, with a note. Inertials are
    written in link axes (`rpy="0 0 0"`) about the centre of mass. Drive values on which the model
    is silent stay as they are.

    Raises
    ------
    InertiaError
        If the model is impossible for rigid bodies and drives.
    DescriptionError
        If the file is no URDF or describes another robot.
    """
    refuse_impossible(model)
    plain = in_plain_friction(model)
    content, source = described_text(original)
    described = read_urdf(original)
    _check_same_robot(described, model, source)
    file = XmlFile.of(content, source)
    links = {span.attributes["name"].strip(): span for span in file.root.all("link")}
    joints = {span.attributes["name"].strip(): span for span in file.root.all("joint")}
    edits: list[Edit] = []
    changed_links, changed_joints, emptied = [], [], []
    for was, link in zip(described.links, model.links, strict=True):
        if not link.inertia_known or np.array_equal(
            was.inertia.parameters, link.inertia.parameters
        ):
            continue
        fixed = [(name, inertia) for name, inertia in was.parts if name != link.name]
        own = (
            link.inertia - LinkInertia(np.sum([inertia.parameters for _, inertia in fixed], axis=0))
            if fixed
            else link.inertia
        )
        if fixed and not (own.mass > 0.0 and own.is_consistent):
            own = link.inertia
            for name, _ in fixed:
                edits += [Edit(span.start, span.stop, "") for span in links[name].all("inertial")]
                emptied.append(name)
        edits += _inertial_edits(file, links[link.name], own)
        changed_links.append(link.name)
    for before, joint in zip(described.joints, plain.joints, strict=True):
        given = {
            "damping": (before.drive.viscous, joint.drive.viscous),
            "friction": (before.drive.coulomb, joint.drive.coulomb),
        }
        values = {
            name: _number(new)
            for name, (old, new) in given.items()
            if new is not None and new != (old or 0.0)
        }
        if values:
            edits += _dynamics_edits(file, joints[joint.name], values)
            changed_joints.append(joint.name)
    edited = file.edited(edits)
    reread, literal = (
        _difference(model, read_urdf(edited, straighten=exact)) for exact in (True, False)
    )
    notes = (*_rounding_note(model, literal), *_emptied_note(emptied), *unsaid_in_urdf(model))
    return EditedUrdf(
        edited, tuple(changed_links), tuple(changed_joints), tuple(emptied), reread, literal, notes
    )


def unsaid_in_urdf(model: RobotModel) -> tuple[str, ...]:
    """Return a note for each thing of the model that changes torques and for which URDF has no
    place.
    """
    plain, notes = in_plain_friction(model), []
    if any("asymmetric_coulomb" in joint.drive.terms for joint in model.joints):
        notes.append(
            "asymmetric Coulomb friction is written as symmetric friction; the rest of it is in the"
            " offset"
        )
    if any("smooth_coulomb" in joint.drive.terms for joint in model.joints):
        notes.append(
            "smooth Coulomb friction is written as dry friction: the same torque where a joint"
            " moves faster than its width"
        )
    for key, symbol, unit in (
        ("armature", "Ia", "kg m^2, or kg where it slides"),
        ("offset", "Fo", "N m, or N where it slides"),
    ):
        values = {
            joint.name: getattr(joint.drive, key)
            for joint in plain.joints
            if getattr(joint.drive, key)
        }
        if values:
            said = ", ".join(f"{name} {value:.6g}" for name, value in values.items())
            notes.append(
                f"URDF has no place for the {key} of the drives, add it yourself ({symbol}"
                f" [{unit}]: {said})"
            )
    notes += left_out_drives(plain, (), "URDF")
    if not np.array_equal(model.gravity, USUAL_GRAVITY):
        notes.append(
            "URDF has no place for gravity; the model has"
            f" ({', '.join(f'{g:.6g}' for g in model.gravity)}) m/s^2 in the root frame, set it"
            " where the file is loaded"
        )
    return tuple(notes)


def _check_same_robot(described: RobotModel, model: RobotModel, source: str) -> None:
    def refuse(what: str) -> None:
        raise DescriptionError(
            f"{source} describes another robot than {model.name}: {what}; give the URDF that the"
            " robot was identified with"
        )

    if described.joint_names != model.joint_names:
        refuse(
            f"its joints are {', '.join(described.joint_names)}, the model's"
            f" {', '.join(model.joint_names)}"
        )
    if described.link_names != model.link_names:
        refuse(
            f"its moving links are {', '.join(described.link_names)}, the model's"
            f" {', '.join(model.link_names)}"
        )
    for there, here in zip(described.joints, model.joints, strict=True):
        if there.parent != here.parent or there.is_revolute != here.is_revolute:
            refuse(
                f"joint {here.name!r} is {there.kind} on link index {there.parent}, the model's"
                f" {here.kind} on {here.parent}"
            )
        off = max(
            float(np.abs(there.before - here.before).max()),
            float(np.abs(there.after - here.after).max()),
        )
        if off > SAME_PLACE:
            refuse(f"the placement of joint {here.name!r} differs by {off:.3g}")


def _inertial_edits(file: XmlFile, link: Span, inertia: LinkInertia) -> list[Edit]:
    tensor, com = inertia.inertia_about_com, " ".join(map(_number, inertia.com))
    moments = {name: _number(tensor[place]) for name, place in _TENSOR.items()}
    inertial = link.first("inertial")
    if inertial is None:
        tag = link.named_as
        said = " ".join(f'{name}="{value}"' for name, value in moments.items())
        parts = (
            f'<{tag("origin")} xyz="{com}" rpy="0 0 0"/><{tag("mass")}'
            f' value="{_number(inertia.mass)}"/><{tag("inertia")} {said}/>'
        )
        return [file.prepended(link, f"<{tag('inertial')}>{parts}</{tag('inertial')}>")]
    origin, mass, moment = (inertial.first(tag) for tag in ("origin", "mass", "inertia"))
    if mass is None or moment is None:
        raise DescriptionError(
            f"link {link.attributes['name']!r}: <inertial> lacks <mass> or <inertia>"
        )
    edits = attribute_edits(mass, {"value": _number(inertia.mass)}) + attribute_edits(
        moment, moments
    )
    if origin is None:
        return [
            *edits,
            file.prepended(inertial, f'<{inertial.named_as("origin")} xyz="{com}" rpy="0 0 0"/>'),
        ]
    turned = (
        {"rpy": "0 0 0"}
        if any(float(angle) != 0.0 for angle in origin.attributes.get("rpy", "").split())
        else {}
    )
    return edits + attribute_edits(origin, {"xyz": com} | turned)


def _dynamics_edits(file: XmlFile, joint: Span, values: dict[str, str]) -> list[Edit]:
    dynamics = joint.first("dynamics")
    if dynamics is not None:
        return attribute_edits(dynamics, values)
    said = " ".join(f'{name}="{value}"' for name, value in values.items())
    return [file.appended(joint, f"<{joint.named_as('dynamics')} {said}/>")]


def _difference(model: RobotModel, read: RobotModel) -> Array:
    q, qd, qdd = sample_states(model, 200)
    expected = inverse_dynamics(model, q, qd, qdd)
    return np.asarray(
        np.abs(inverse_dynamics(replace(read, gravity=model.gravity), q, qd, qdd) - expected).max(
            axis=0
        )
    )


def _rounding_note(model: RobotModel, literal: Array) -> tuple[str, ...]:
    if literal.max() <= NOTABLE:
        return ()
    worst = int(np.argmax(literal))
    return (
        (
            "the file rounds right angles (1.5708), which asbuilt reads as exact; a program that"
            f" reads them to the letter gets torques that differ by up to {literal[worst]:.2g}"
            f" {'N m' if model.joints[worst].is_revolute else 'N'} (joint"
            f" {model.joint_names[worst]})"
        ),
    )


def _emptied_note(emptied: list[str]) -> tuple[str, ...]:
    if not emptied:
        return ()
    return (
        (
            f"the inertials of {', '.join(emptied)} were removed: what is left of the carrier"
            " without them would be no possible body, so the carrier has the inertia of the whole"
        ),
    )


def _number(value: float) -> str:
    return repr(float(value) + 0.0)
