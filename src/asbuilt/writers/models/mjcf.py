"""A robot as an MJCF file of its own, for MuJoCo."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree.ElementTree import Comment, Element, SubElement, fromstring, indent, tostring

import numpy as np

from asbuilt.description.formats.mjcf_text import mjcf_text
from asbuilt.description.model import RobotModel
from asbuilt.writers.files import atomic_write
from asbuilt.writers.models.physical import in_plain_friction, left_out_drives, refuse_impossible

STIFF_FRICTION = ("0.002 1", "0.9999 0.9999 0.001 0.5 2")
"""Reference and impedance that let dry friction reach its full size at small speeds.

Two time steps of 1 ms, and a constraint as hard as MuJoCo has them.
"""
CARRIED = frozenset(("spring", "motor_armature", "motor_viscous", "motor_coulomb"))
"""Further drive terms that MuJoCo has a place for, beside friction that is written as plain one."""


def exported_mjcf(model: RobotModel) -> str:
    """Return the robot as MJCF.

    `mjcf_text` with all of the drives that MuJoCo has, and in comments what MJCF cannot say.

    Armature, viscous and dry friction are the joint's; asymmetric dry friction is symmetric
    friction and an offset, smooth friction a dry one; a spring is the joint's stiffness; a motor
    that several joints turn is a fixed tendon with damping, dry friction and armature; an offset is
    the bias of the joint's actuator, whose control is the torque that the drive has to exert.
    MuJoCo's dry friction grows with speed and acceleration up to its full size; where the joint
    moves faster than `|qdd|` times a millisecond, inverse dynamics holds all of it.

    Raises
    ------
    InertiaError
        If the model is impossible for rigid bodies and drives.
    """
    refuse_impossible(model)
    plain = in_plain_friction(model)
    root = fromstring(mjcf_text(plain))
    elements = {element.get("name"): element for element in root.iter("joint")}
    for joint in plain.joints:
        element = elements[joint.name]
        if joint.drive.coulomb:
            element.attrib.update(_dry_friction(joint.drive.coulomb))
        if stiffness := joint.drive.terms.get("spring", {}).get("Ks"):
            element.attrib.update(stiffness=repr(stiffness), springref="0")
    for motor, joint in zip(root.iter("motor"), plain.joints, strict=True):
        if offset := joint.drive.offset:
            motor.tag = "general"
            motor.attrib.update(biastype="affine", biasprm=f"{-offset!r} 0 0")
    _add_motors(root, model)
    for place, note in enumerate((*model.notes, *unsaid_in_mjcf(model))):
        root.insert(place, Comment(f" {' '.join(note.replace('--', '- -').split()).rstrip('-')} "))
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _add_motors(root: Element, model: RobotModel) -> None:
    """Add a fixed tendon for every motor that several joints turn.

    Its length is the motor's coordinate `s = T q`.
    """
    tendons = Element("tendon")
    for joint, shares in zip(model.joints, model.motor_shares, strict=True):
        armature, viscous, coulomb = (
            joint.drive.terms.get(f"motor_{what}", {}).get(symbol, 0.0)
            for what, symbol in (("armature", "Iam"), ("viscous", "Fvm"), ("coulomb", "Fcm"))
        )
        if not shares.any() or not any((armature, viscous, coulomb)):
            continue
        tendon = SubElement(
            tendons,
            "fixed",
            {
                "name": f"motor of {joint.name}",
                "armature": repr(armature),
                "damping": repr(viscous),
            },
        )
        if coulomb:
            tendon.attrib.update(_dry_friction(coulomb))
        for k in np.flatnonzero(shares):
            SubElement(tendon, "joint", joint=model.joints[k].name, coef=repr(float(shares[k])))
    if len(tendons):
        root.insert(list(root).index(next(root.iter("actuator"))), tendons)


def _dry_friction(size: float) -> dict[str, str]:
    reference, impedance = STIFF_FRICTION
    return {"frictionloss": repr(size), "solreffriction": reference, "solimpfriction": impedance}


def unsaid_in_mjcf(model: RobotModel) -> tuple[str, ...]:
    """Return a note for what changes torques and has no place in MJCF, or one where it is easily
    overlooked.
    """
    plain = in_plain_friction(model)
    offsets = [
        f"{joint.name} {joint.drive.offset:.6g}" for joint in plain.joints if joint.drive.offset
    ]
    notes = left_out_drives(plain, CARRIED, "MJCF")
    if any("smooth_coulomb" in joint.drive.terms for joint in model.joints):
        notes = (
            (
                "MuJoCo has smooth Coulomb friction as dry friction: the same torque where a joint"
                " moves faster than its width"
            ),
            *notes,
        )
    if not offsets:
        return notes
    return (
        (
            "the offsets of the drives are the bias of the actuators, so mj_inverse does not count"
            f" them (Fo [N m, or N where it slides]: {', '.join(offsets)})"
        ),
        *notes,
    )


def write_mjcf(path: str | os.PathLike[str], model: RobotModel) -> tuple[Path, tuple[str, ...]]:
    """Write the robot for MuJoCo; returns the path and notes on what the reader must know."""
    return atomic_write(path, exported_mjcf(model)), unsaid_in_mjcf(model)
