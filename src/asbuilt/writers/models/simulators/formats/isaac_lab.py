"""Actuator configuration for Isaac Lab."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from asbuilt.writers.models.simulators.simulator_format import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
)

HEAD = '''"""Actuators of {origin}.

For isaaclab 2 (Isaac Sim 5, where joint friction is a torque). Use:

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
            {limit}=EFFORT_LIMIT,
            armature=ARMATURE,
            friction=COULOMB_FRICTION,
            dynamic_friction=COULOMB_FRICTION,
            viscous_friction=VISCOUS_FRICTION,{more}
        )
    }}
'''
DELAYED = """
            min_delay=round(DELAY / physics_step),
            max_delay=round(DELAY / physics_step),"""


class IsaacLab(SimulatorFormat):
    """Python text with one actuator group; with a delay, an explicit delayed PD actuator."""

    key = "isaac-lab"
    title = "Isaac Lab actuator configuration (Python)"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the module and its notes."""
        limits = {
            joint.name: joint.limits.torque
            for joint in drives.plain.joints
            if np.isfinite(joint.limits.torque)
        }
        tables = {
            "STIFFNESS": (drives.by_joint(lambda j: j.drive.kp), "N m/rad or N/m"),
            "DAMPING": (drives.by_joint(lambda j: j.drive.kd), "N m s/rad or N s/m"),
            "EFFORT_LIMIT": (limits, "N m or N"),
            "ARMATURE": (drives.by_joint(lambda j: j.drive.armature), "kg m^2 or kg"),
            "COULOMB_FRICTION": (drives.by_joint(lambda j: j.drive.coulomb), "N m or N"),
            "VISCOUS_FRICTION": (
                drives.by_joint(lambda j: j.drive.viscous),
                "N m s/rad or N s/m",
            ),
        }
        text = HEAD.format(
            origin=drives.origin,
            kind="DelayedPDActuatorCfg" if drives.delay else "ImplicitActuatorCfg",
            limit="effort_limit" if drives.delay else "effort_limit_sim",
            tables="".join(_table(name, *each) for name, each in tables.items()),
            delay=drives.delay,
            more=DELAYED if drives.delay else "",
        )
        notes = drives.left_out("an Isaac Lab actuator", delay=True)
        if drives.delay:
            notes = (*notes, "the delay is rounded to whole physics steps")
        return text, notes


def _table(name: str, values: dict[str, float], unit: str) -> str:
    """Return a dictionary as Python text; joint names are regular expressions there."""
    rows = "".join(f"    {re.escape(joint)!r}: {each!r},\n" for joint, each in values.items())
    return f"{name} = {{  # {unit}\n{rows}}}\n"


SIMULATOR_FORMATS.register("isaac-lab", IsaacLab())
