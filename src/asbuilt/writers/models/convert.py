"""Conversion of a robot description from one format into another, and with computed masses."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import InertiaError, UsageError
from asbuilt.findings import Cure, join_names
from asbuilt.writers.files import file_lines
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.mjcf import write_mjcf
from asbuilt.writers.models.physical import note_implausible_links
from asbuilt.writers.models.robot_toml import write_robot_toml
from asbuilt.writers.models.urdf import write_urdf


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """Hold the file written and what it cannot hold.

    Parameters
    ----------
    robot
        The robot that was written.
    path
        The file.
    notes
        What the file cannot hold.
    torque_difference
        Largest rigid-body torque difference (n,) [N m or N] of the file read back.
    """

    robot: RobotModel
    path: Path
    notes: tuple[str, ...]
    torque_difference: Array

    def as_document(self) -> dict[str, Any]:
        """Return the conversion as plain texts and numbers."""
        return {
            "robot": self.robot.name,
            "joints": list(self.robot.joint_names),
            "locked_joints": dict(self.robot.locked_joints),
            "gravity": self.robot.gravity.tolist(),
            "files": {"robot": str(self.path)},
            "notes": list(self.notes),
            "torque_difference": self.torque_difference.tolist(),
        }

    def as_text(self) -> str:
        """Return the file and the notes, one a line."""
        files = file_lines({"robot": self.path}, {"robot": self.notes}, 9)
        return "\n".join([f"{self.robot.name}: {self.robot.n_joints} joints", *files])


def convert_robot(
    robot: RobotModel | str | os.PathLike[str], path: str | os.PathLike[str]
) -> Conversion:
    """Write a robot in the format of a file name, and read it back to compare the torques.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    path
        File to write: `.toml` (robot file, which holds everything but shapes), `.urdf`, or `.xml`
        or `.mjcf` (MJCF, for MuJoCo).

    Returns
    -------
    Conversion
        The file, and notes on what it cannot hold.

    Raises
    ------
    UsageError
        If the suffix belongs to no format.
    InertiaError
        If a URDF or an MJCF file is asked for and the inertia of a link is physically inconsistent.
    """
    model = load_robot(robot)
    if Path(path).suffix.lower() not in TITLES:
        raise UsageError(
            f"{path} names no format to write; its suffix must be one of {', '.join(TITLES)}",
            value=str(path),
        )
    if model.locked_joints:
        # Positions of locked joints are part of the geometry now, and only the note knows them.
        held = ", ".join(f"{name} at {value!r}" for name, value in model.locked_joints.items())
        model = replace(model, notes=(*model.notes, f"locked when converted: {held}"))
    try:
        written, notes = _write_as_named(path, model)
    except InertiaError as problem:
        # The same error with a way out that this format does not have.
        problem.cure = Cure("write a robot file (.toml), which takes any inertia, or correct it")
        raise
    apart, differs = _read_back(written, model)
    notes = (*note_implausible_links(model), *notes, *differs)
    return Conversion(model, written, notes, apart)


TITLES = {".toml": "", ".urdf": "URDF", ".xml": "MJCF", ".mjcf": "MJCF"}
"""Name of the format of each suffix; the robot file needs none."""


def _write_as_named(
    path: str | os.PathLike[str], model: RobotModel
) -> tuple[Path, tuple[str, ...]]:
    """Write a robot in the format of a suffix; return the file, and notes on what it lacks."""
    title = TITLES[Path(path).suffix.lower()]
    if not title:
        return write_robot_toml(path, model), ()
    written, notes = (write_urdf if title == "URDF" else write_mjcf)(path, model)
    # Limits that the format has no place for.
    without = ("acceleration", "jerk") if title == "URDF" else ("velocity", "acceleration", "jerk")
    there = {
        f"{name} limits": any(np.isfinite(getattr(joint.limits, name)) for joint in model.joints)
        for name in without
    } | {
        "the coupling of the motors": model.motor_coupling is not None,
        "gear ratios": any(joint.drive.gear_ratio is not None for joint in model.joints),
        "the parts of merged links": any(link.parts for link in model.links),
        "names of lengths": bool(model.lengths),
        "which inertias are unknown": not all(link.inertia_known for link in model.links),
    }
    lost = [what for what, is_there in there.items() if is_there]
    note = f"{title} has no place for {join_names(lost)}; the robot file (.toml) has"
    return written, (*notes, *([note] if lost else []))


def _read_back(path: Path, model: RobotModel) -> tuple[Array, tuple[str, ...]]:
    """Return the torque difference (n,) of the file read back, and a note if there is one."""
    try:
        read = load_robot(path)
    except ImportError:
        return np.full(model.n_joints, np.nan), ("not read back: MuJoCo is not installed",)
    order = [read.joint_names.index(name) for name in model.joint_names]
    # Random states at which torques are compared.
    states = draw_sample_states(model, 100)
    expected = inverse_dynamics(model, *states)
    # A format may keep its own order of joints.
    there = [part[:, np.argsort(order)] for part in states]
    # Gravity is no part of a URDF.
    torque = inverse_dynamics(replace(read, gravity=model.gravity), *there)[:, order]
    apart = np.abs(torque - expected).max(axis=0)
    size = float(np.abs(expected).max(initial=0.0))
    # Largest torque difference of a file read back, relative to the torque, without a note.
    if apart.max(initial=0.0) <= 1e-10 * max(size, 1.0):
        return apart, ()
    worst = int(np.argmax(apart))
    return apart, (
        f"read back, the torque of {model.joint_names[worst]} differs by up to"
        f" {apart[worst]:.2g} {model.joints[worst].torque_unit}",
    )
