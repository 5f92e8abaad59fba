"""The servo for ros2_control: the parameters of its PID controller."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from asbuilt.writers import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
    quote_yaml,
)


class Ros2Control(SimulatorFormat):
    """The gains and limits of `pid_controller`, which reads all that is written."""

    key = "ros2-control"
    title = "ros2_control: the gains of pid_controller (.yaml)"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the parameters, and notes."""
        friction = any(
            joint.drive.viscous or joint.drive.coulomb or joint.drive.armature
            for joint in drives.plain.joints
        )
        return _write_gains(drives), (
            *drives.left_out("pid_controller"),
            *(["pid_controller has no place for armature and friction"] if friction else []),
        )


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
