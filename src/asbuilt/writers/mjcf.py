"""A robot as an MJCF file of its own, for MuJoCo."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree.ElementTree import Comment, fromstring, indent, tostring

from asbuilt.description.mjcf_text import mjcf_text
from asbuilt.description.model import RobotModel
from asbuilt.writers.files import atomic_write
from asbuilt.writers.physical import refuse_impossible

STIFF_FRICTION = {"solreffriction": "0.002 1", "solimpfriction": "0.9999 0.9999 0.001 0.5 2"}
"""Lets dry friction reach its full size at small speeds: two time steps of 1 ms, and a constraint as hard as MuJoCo has them."""


def exported_mjcf(model: RobotModel) -> str:
    """Return the robot as MJCF: `mjcf_text` with dry friction as hard as MuJoCo has it, and in comments what MJCF cannot say.

    MuJoCo's dry friction grows with speed and acceleration up to its full size; where the joint moves faster than `|qdd|` times a millisecond,
    inverse dynamics holds all of it.

    Raises
    ------
    InertiaError
        If the model is impossible for rigid bodies and drives.
    """
    refuse_impossible(model)
    root = fromstring(mjcf_text(model))
    for joint in root.iter("joint"):
        if joint.get("frictionloss"):
            joint.attrib.update(STIFF_FRICTION)
    for place, note in enumerate((*model.notes, *unsaid_in_mjcf(model))):
        root.insert(place, Comment(f" {' '.join(note.replace('--', '- -').split()).rstrip('-')} "))
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def unsaid_in_mjcf(model: RobotModel) -> tuple[str, ...]:
    """Return a note for what changes torques and has no place in MJCF."""
    offsets = [f"{joint.name} {joint.drive.offset:.6g}" for joint in model.joints if joint.drive.offset]
    if not offsets:
        return ()
    return (
        f"MJCF has no place for the offset of the drives, add it to the torque that MuJoCo finds (Fo [N m, or N where it slides]: {', '.join(offsets)})",
    )


def write_mjcf(path: str | os.PathLike[str], model: RobotModel) -> tuple[Path, tuple[str, ...]]:
    """Write the robot for MuJoCo; returns the path and notes on what the reader must know."""
    return atomic_write(path, exported_mjcf(model)), unsaid_in_mjcf(model)
