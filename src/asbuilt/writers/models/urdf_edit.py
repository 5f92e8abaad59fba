"""The user's URDF with inertials and joint dynamics as built, all other bytes kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import format_number
from asbuilt.description import LinkInertia, described_text
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.model import USUAL_GRAVITY, RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import DescriptionError
from asbuilt.findings import Cure
from asbuilt.writers.models.as_built import FEASIBLE_NOTE, draw_sample_states
from asbuilt.writers.models.physical import (
    convert_to_plain_friction,
    note_left_out_drives,
    refuse_inconsistent,
)
from asbuilt.writers.models.xml_spans import (
    Edit,
    Span,
    XmlFile,
    comment_text,
    list_attribute_edits,
)

TENSOR = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def edit_urdf(
    original: str | Path | bytes, model: RobotModel, remarks: Sequence[str] = ()
) -> tuple[bytes, tuple[str, ...]]:
    """Put inertias, viscous and Coulomb friction of `model` into a URDF of the same robot.

    All other bytes are kept, and comments hold `remarks` and say which masses are a choice.
    The identified inertia of a moving link includes everything fixed to it: links behind fixed
    joints keep their inertials and the moving link gets the remainder if that is physically
    consistent; else it gets the whole and theirs are removed, with a note.
    Inertials are written in link axes (`rpy="0 0 0"`) about the centre of mass. Drive values that
    the model does not have stay as they are.

    Returns the file, in the encoding of the original, and notes on what it cannot hold.

    Raises
    ------
    InertiaError
        If the model is physically inconsistent.
    DescriptionError
        If the file is no URDF or describes another robot.
    """
    refuse_inconsistent(model)
    plain = convert_to_plain_friction(model)
    content, source = described_text(original)
    kind = model.base_kind
    # Of the same joints as the model, since locked ones stay in the file.
    described = _lock_alike(read_urdf(original, base=kind), model)
    _check_same_robot(described, model, source)
    file = XmlFile.of(content, source)
    links, joints = (
        {span.attributes["name"].strip(): span for span in file.root.all(tag)}
        for tag in ("link", "joint")
    )
    edits: list[Edit] = []
    emptied: list[str] = []
    # Unchanged inertias keep the bytes of the file.
    for was, link in zip(described.links, model.links, strict=True):
        if (
            link.negligible
            or not link.inertia_known
            or np.array_equal(was.inertia.parameters, link.inertia.parameters)
        ):
            continue
        # The link's own inertial is what is edited; the others are subtracted.
        fixed = [(name, inertia) for name, inertia in was.parts if name != link.name]
        own = (
            link.inertia - LinkInertia(np.sum([inertia.parameters for _, inertia in fixed], axis=0))
            if fixed
            else link.inertia
        )
        # A part of CAD may be heavier than the link as built.
        if fixed and not (own.mass > 0.0 and own.is_consistent):
            own = link.inertia
            for name, _ in fixed:
                edits += [Edit(span.start, span.stop, "") for span in links[name].all("inertial")]
                emptied.append(name)
        edits += _list_inertial_edits(file, links[link.name], own)
    for before, joint in zip(described.joints, plain.joints, strict=True):
        values = {
            name: format_number(new)
            for name, old, new in (
                ("damping", before.drive.viscous, joint.drive.viscous),
                ("friction", before.drive.coulomb, joint.drive.coulomb),
            )
            # A value that the file lacks counts as zero, as its readers take it.
            if new is not None and new != (old or 0.0)
        }
        # Joints of a free base are not in the file.
        if values and joint.name in joints:
            # The driven joint has the friction of all that it moves: followers must not add theirs.
            edits += _list_dynamics_edits(file, joints[joint.name], values)
            driven = model.link_shares[model.n_joints :, model.joint_names.index(joint.name)]
            for follower, share in zip(model.followers, driven, strict=True):
                edits += _list_zero_friction_edits(joints[follower.name], values) if share else []
    # Masses that data cannot tell are a choice, which a reader of the file must know.
    feasible = [note for note in model.notes if note.startswith(FEASIBLE_NOTE)]
    comments = "".join(f"\n  <!--{comment_text(note)}-->" for note in (*feasible, *remarks))
    # Behind the root's start tag: first thing that a reader sees.
    edited = file.edited([*edits, Edit(file.root.inner, file.root.inner, comments)])
    # Read as other programs do, without straightening: what the user's simulator will compute.
    literal = measure_torque_difference(
        model, _lock_alike(read_urdf(edited, straighten=False, base=kind), model)
    )
    worst = int(np.argmax(literal))
    held = [
        f"{name} at {value:.4g}" for name, value in model.locked_joints.items() if name in joints
    ]
    cases = {
        "the file rounds right angles (1.5708), which asbuilt reads as exact; taken literally they"
        f" change torques by up to {literal[worst]:.2g}"
        f" {model.joints[worst].torque_unit} (joint {model.joint_names[worst]})":
        # Torque difference [N m or N] from which a note is written.
        literal[worst] > 1e-9,
        f"the joints {', '.join(held)} were locked when the robot was identified: they stay in the"
        " file, and what was identified is the inertia of their carriers with them in place, exact"
        " where they are locked": bool(held),
        f"the inertials of {', '.join(emptied)} were removed, because the remainder of their"
        " carrier would be physically inconsistent; the carrier has the inertia of the whole": bool(
            emptied
        ),
    }
    notes = (note for note, holds in cases.items() if holds)
    return edited, (*notes, *note_urdf_limits(model))


def note_urdf_limits(model: RobotModel) -> tuple[str, ...]:
    """Return notes on what changes torques and has no place in URDF."""
    plain = convert_to_plain_friction(model)
    terms = {key for joint in model.joints for key in joint.drive.terms}
    cases = {
        "asymmetric Coulomb friction is written as symmetric friction; the offset holds the"
        " rest": "asymmetric_coulomb" in terms,
        "smooth Coulomb friction is written as dry friction: equal torques if a joint moves"
        " faster than its width": "smooth_coulomb" in terms,
    }
    for key, symbol, unit in (
        ("armature", "Ia", "kg m^2, or kg for prismatic joints"),
        ("offset", "Fo", "N m, or N for prismatic joints"),
    ):
        values = {joint.name: getattr(joint.drive, key) for joint in plain.joints}
        listed = ", ".join(f"{name} {value:.6g}" for name, value in values.items() if value)
        cases[
            f"URDF has no place for the {key} of the drives; add it in the simulator ({symbol}"
            f" [{unit}]: {listed})"
        ] = bool(listed)
    # Notes of drive terms are there only where one is lost.
    cases |= dict.fromkeys(note_left_out_drives(plain, (), "URDF"), True)
    cases[
        "URDF has no place for gravity; the model has"
        f" ({', '.join(f'{g:.6g}' for g in model.gravity)}) m/s^2 in the root frame; set it in"
        " the simulator"
    ] = not np.array_equal(model.gravity, USUAL_GRAVITY)
    return tuple(note for note, holds in cases.items() if holds)


def _check_same_robot(described: RobotModel, model: RobotModel, source: str) -> None:
    def mismatch(what: str) -> DescriptionError:
        return DescriptionError(
            f"{source} describes another robot than {model.name}: {what}",
            cure=Cure("give the URDF that the robot was identified with"),
            file=source,
        )

    for same, what in (
        (
            described.joint_names == model.joint_names,
            f"its joints are {', '.join(described.joint_names)}, the model's"
            f" {', '.join(model.joint_names)}",
        ),
        (
            np.array_equal(described.link_shares, model.link_shares),
            "its joints follow others than the model's",
        ),
        (
            described.link_names == model.link_names,
            f"its moving links are {', '.join(described.link_names)}, the model's"
            f" {', '.join(model.link_names)}",
        ),
    ):
        if not same:
            raise mismatch(what)
    # Limits and friction may differ: they are what is identified.
    for there, here in zip(described.moving_joints, model.moving_joints, strict=True):
        if there.parent != here.parent or there.is_revolute != here.is_revolute:
            raise mismatch(
                f"joint {here.name!r} is {there.kind} on link index {there.parent}, the model's"
                f" {here.kind} on {here.parent}"
            )
        off = max(
            float(np.abs(there.before - here.before).max()),
            float(np.abs(there.after - here.after).max()),
        )
        # Largest difference of placements [m, 1] in two descriptions of one robot.
        if off > 1e-9:
            raise mismatch(f"the placement of joint {here.name!r} differs by {off:.3g}")


def _list_inertial_edits(file: XmlFile, link: Span, inertia: LinkInertia) -> list[Edit]:
    # One place each, since the tensor is symmetric.
    tensor = inertia.inertia_about_com
    com = " ".join(map(format_number, inertia.com))
    moments = {name: format_number(tensor[place]) for name, place in TENSOR.items()}
    inertial = link.first("inertial")
    # A link without inertial in the file has been identified nonetheless.
    if inertial is None:
        tag = link.named_as
        attributes = " ".join(f'{name}="{value}"' for name, value in moments.items())
        parts = (
            f'<{tag("origin")} xyz="{com}" rpy="0 0 0"/><{tag("mass")}'
            f' value="{format_number(inertia.mass)}"/><{tag("inertia")} {attributes}/>'
        )
        return [file.prepended(link, f"<{tag('inertial')}>{parts}</{tag('inertial')}>")]
    origin, mass, moment = (inertial.first(tag) for tag in ("origin", "mass", "inertia"))
    if mass is None or moment is None:
        raise DescriptionError(
            f"link {link.attributes['name']!r}: <inertial> lacks <mass> or <inertia>"
        )
    edits = list_attribute_edits(
        mass,
        {"value": format_number(inertia.mass)},
        # A URDF without <origin> has the centre of mass at the link's origin.
    ) + list_attribute_edits(moment, moments)
    if origin is None:
        markup = f'<{inertial.named_as("origin")} xyz="{com}" rpy="0 0 0"/>'
        return [*edits, file.prepended(inertial, markup)]
    # Moments are in axes of the link: a rotation of the old ones would turn them.
    turned = any(float(angle) != 0.0 for angle in origin.attributes.get("rpy", "").split())
    return edits + list_attribute_edits(origin, {"xyz": com} | ({"rpy": "0 0 0"} if turned else {}))


def _list_dynamics_edits(file: XmlFile, joint: Span, values: dict[str, str]) -> list[Edit]:
    dynamics = joint.first("dynamics")
    if dynamics is not None:
        # A joint without friction in the file gets the element.
        return list_attribute_edits(dynamics, values)
    attributes = " ".join(f'{name}="{value}"' for name, value in values.items())
    return [file.appended(joint, f"<{joint.named_as('dynamics')} {attributes}/>")]


def _list_zero_friction_edits(joint: Span, values: dict[str, str]) -> list[Edit]:
    """Return edits that set a follower's friction to 0, since its driven joint holds it."""
    dynamics = joint.first("dynamics")
    if dynamics is None:
        return []
    return list_attribute_edits(
        dynamics, {name: "0" for name in values if name in dynamics.attributes}
    )


def measure_torque_difference(model: RobotModel, read: RobotModel) -> Array:
    """Return the largest torque difference (n,) [N m or N] of a file that was read to the model.

    Links of negligible mass have the parameters of the file in both.
    """
    states = draw_sample_states(model, 200)
    chi = model.parameters
    # What the file holds there is no error of the writer.
    for k in (k for k, link in enumerate(model.links) if link.negligible):
        chi[10 * k : 10 * k + 10] = read.links[k].inertia.parameters
    torque = inverse_dynamics(replace(read, gravity=model.gravity), *states)
    expected = inverse_dynamics(model, *states, parameters=chi)
    return np.asarray(np.abs(torque - expected).max(axis=0))


def _lock_alike(described: RobotModel, model: RobotModel) -> RobotModel:
    """Return a described robot with the joints locked that are locked in the model."""
    held = {
        name: value
        for name, value in model.locked_joints.items()
        if name in {joint.name for joint in described.moving_joints}
    }
    return described.locked(held)
