"""Joints for ros2_control: URDF tags, or the parameters of its PID controller."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from asbuilt.description import Joint
from asbuilt.writers import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
    quote_yaml,
)


class Ros2Control(SimulatorFormat):
    """URDF tags with interfaces, limits and drive parameters; `.yaml`: a PID controller's gains."""

    key = "ros2-control"
    title = "ros2_control: URDF tags, or the gains of pid_controller (.yaml)"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the tags or the parameters, and notes."""
        if path.suffix.lower() in (".yaml", ".yml"):
            friction = any(
                joint.drive.viscous or joint.drive.coulomb or joint.drive.armature
                for joint in drives.plain.joints
            )
            return _write_gains(drives), (
                *drives.left_out("pid_controller"),
                *(["pid_controller has no place for armature and friction"] if friction else []),
            )
        return _write_tags(drives), (
            *drives.left_out("ros2_control", offset=True, delay=True, gains=False),
            "ros2_control hands the parameters to the hardware component, which decides what to do"
            " with them",
        )


def _write_tags(drives: ExportedDrives) -> str:
    root = Element("ros2_control", {"name": f"{drives.model.name}_as_built", "type": "system"})
    root.append(Comment(f" {drives.origin.replace('--', '- -')} "))
    hardware = SubElement(root, "hardware")
    SubElement(hardware, "plugin").text = "mock_components/GenericSystem"
    for joint in drives.plain.joints:
        _add_joint(SubElement(root, "joint", name=joint.name), joint, drives.delay)
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _add_joint(element: Element, joint: Joint, delay: float) -> None:
    limits, drive = joint.limits, joint.drive
    commanded = "position" if drive.kp is not None else "effort"
    lowest, highest = (
        (limits.lower, limits.upper) if commanded == "position" else (-limits.torque, limits.torque)
    )
    command = SubElement(element, "command_interface", name=commanded)
    for bound, limit in (("min", lowest), ("max", highest)):
        if np.isfinite(limit):
            SubElement(command, "param", name=bound).text = repr(float(limit))
    for state in ("position", "velocity", "effort"):
        SubElement(element, "state_interface", name=state)
    for name, value in (
        ("kp", drive.kp),
        ("kd", drive.kd),
        ("effort_limit", limits.torque if np.isfinite(limits.torque) else None),
        ("velocity_limit", limits.velocity if np.isfinite(limits.velocity) else None),
        ("command_delay", delay or None),
        ("armature", drive.armature),
        ("viscous_friction", drive.viscous),
        ("coulomb_friction", drive.coulomb),
        ("torque_offset", drive.offset),
    ):
        if value is not None:
            SubElement(element, "param", name=name).text = repr(float(value))


def _write_gains(drives: ExportedDrives) -> str:
    """Return the parameters of a PID controller from positions to efforts."""
    lines = [
        f"# {drives.origin}",
        "pid_controller:",
        "  ros__parameters:",
        f"    dof_names: [{', '.join(map(quote_yaml, drives.model.joint_names))}]",
        "    command_interface: effort",
        "    reference_and_state_interfaces: [position, velocity]",
        "    gains:",
    ]
    for joint in drives.plain.joints:
        lines += [
            f"      {quote_yaml(joint.name)}:",
            f"        p: {joint.drive.kp or 0.0!r}",
            "        i: 0.0",
            f"        d: {joint.drive.kd or 0.0!r}",
        ]
        if np.isfinite(joint.limits.torque):
            lines += [
                f"        u_clamp_max: {joint.limits.torque!r}",
                f"        u_clamp_min: {-joint.limits.torque!r}",
            ]
    return "\n".join(lines) + "\n"


SIMULATOR_FORMATS.register("ros2-control", Ros2Control())
