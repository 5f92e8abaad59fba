"""Actuator configuration for Isaac Lab."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from asbuilt.writers import (
    SIMULATOR_FORMATS,
    UNLIMITED,
    ExportedDrives,
    SimulatorFormat,
)

HEAD = '''"""Actuators of {origin}.

For isaaclab 2.3 and 3 (Isaac Sim 5 and later, where joint friction is a torque). Use:

    ArticulationCfg(..., actuators=actuators(physics_step=0.005))
"""

from isaaclab.actuators import {kind}

{tables}
DELAY = {delay!r}  # of the command [s]


def actuators(physics_step):
    """Return the actuators for a physics step [s]."""
    return {{
        "as_built": {kind}(
            joint_names_expr=list(STIFFNESS),
            stiffness=STIFFNESS,
            damping=DAMPING,
{limit}            armature=ARMATURE,
            friction=COULOMB_FRICTION,
            dynamic_friction=COULOMB_FRICTION,
            viscous_friction=VISCOUS_FRICTION,{more}
        )
    }}
'''
DELAYED = """
            min_delay=round(DELAY / physics_step),
            max_delay=round(DELAY / physics_step),"""
MOTOR = """
            saturation_effort={effort!r},
            velocity_limit={speeds},"""


class IsaacLab(SimulatorFormat):
    """Python text with one actuator group.

    With a delay it is an explicit delayed PD actuator, with torque limits that fall with the speed
    a DC motor.
    """

    key = "isaac-lab"
    title = "Isaac Lab actuator configuration (Python)"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the module and its notes."""
        # A joint that the table lacks would have a limit of zero.
        limits = {joint.name: min(joint.limits.torque, UNLIMITED) for joint in drives.plain.joints}
        limited = any(limit < UNLIMITED for limit in limits.values())
        tables = {
            "STIFFNESS": (drives.by_joint(lambda j: j.drive.kp), "N m/rad or N/m"),
            "DAMPING": (drives.by_joint(lambda j: j.drive.kd), "N m s/rad or N s/m"),
            **({"EFFORT_LIMIT": (limits, "N m or N")} if limited else {}),
            "ARMATURE": (drives.by_joint(lambda j: j.drive.armature), "kg m^2 or kg"),
            "COULOMB_FRICTION": (drives.by_joint(lambda j: j.drive.coulomb), "N m or N"),
            "VISCOUS_FRICTION": (
                drives.by_joint(lambda j: j.drive.viscous),
                "N m s/rad or N s/m",
            ),
        }
        kind, more = _choose_actuator(drives)
        holder = "effort_limit_sim" if kind == "ImplicitActuatorCfg" else "effort_limit"
        text = HEAD.format(
            origin=drives.origin,
            kind=kind,
            limit=f"            {holder}=EFFORT_LIMIT,\n" if limited else "",
            tables="".join(_write_table(name, *table) for name, table in tables.items()),
            delay=drives.delay,
            more=more,
        )
        delayed = kind == "DelayedPDActuatorCfg"
        return text, (
            *drives.left_out("an Isaac Lab actuator", delay=delayed, falling=kind == "DCMotorCfg"),
            *(["the delay is rounded to whole physics steps"] if delayed else []),
            "masses and inertias of links are in a URDF or a USD overlay",
        )


def _choose_actuator(drives: ExportedDrives) -> tuple[str, str]:
    """Return the class of the actuator, and further settings of it.

    `DCMotorCfg` has one torque for all joints, which falls to zero at the velocity limit, and no
    delay.
    """
    servo = drives.result.servo
    if servo is not None and np.all(servo.falling) and len(set(servo.torque_limit)) == 1:
        speeds = zip(drives.model.joint_names, servo.no_load_speed, strict=True)
        listed = ", ".join(f"{re.escape(name)!r}: {speed!r}" for name, speed in speeds)
        return "DCMotorCfg", MOTOR.format(effort=servo.torque_limit[0], speeds=f"{{{listed}}}")
    if drives.delay:
        return "DelayedPDActuatorCfg", DELAYED
    return "ImplicitActuatorCfg", ""


def _write_table(name: str, values: dict[str, float], unit: str) -> str:
    """Return a dictionary as Python text; joint names are regular expressions there."""
    rows = "".join(f"    {re.escape(joint)!r}: {value!r},\n" for joint, value in values.items())
    return f"{name} = {{  # {unit}\n{rows}}}\n"


SIMULATOR_FORMATS.register("isaac-lab", IsaacLab())
