"""Actuators and ranges for domain randomization in mjlab."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from asbuilt.identification import draw_ensemble
from asbuilt.writers import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
)

FIELDS = {"dof_armature": "Ia", "dof_damping": "Fv", "dof_frictionloss": "Fc"}
"""Field of MuJoCo and the symbol of the parameter that it holds."""
TEXT = '''"""Actuators and ranges of {origin}.

For mjlab 1.6. actuators(physics_step) goes into EntityArticulationInfoCfg(actuators=...), events()
into the events of the environment: absolute values, 5 to 95 % of what the recording allows. Ranges
of single joints know no correlation; an ensemble of asbuilt keeps it.
"""

from mjlab.actuator import {kind}
from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

# joint: stiffness [N m/rad], damping [N m s/rad], effort limit [N m], armature [kg m^2],
# friction loss [N m], viscous friction [N m s/rad]; in N and m where the joint slides
JOINTS = {{
{joints}}}
DELAY = {delay!r}  # of the command [s]
RANGES = {{
{ranges}}}


def actuators(physics_step):
    """Return one actuator for each joint, for a physics step [s]."""
    lag = round(DELAY / physics_step)
    return tuple(
        {kind}(
            target_names_expr=(name,),
            stiffness=kp,
            damping=kd,
            effort_limit=limit,
            armature=armature,
            frictionloss=friction,
            viscous_damping=viscous,
            delay_min_lag=lag,
            delay_max_lag=lag,
        )
        for name, (kp, kd, limit, armature, friction, viscous) in JOINTS.items()
    )


def events(entity="robot"):
    """Return the events that randomize armature, damping and friction loss joint by joint."""
    return {{
        f"{{field}} of {{name}}": EventTermCfg(
            mode="startup",
            func=getattr(dr, field),
            params={{
                "asset_cfg": SceneEntityCfg(entity, joint_names=(name,)),
                "operation": "abs",
                "ranges": span,
            }},
        )
        for field, spans in RANGES.items()
        for name, span in spans.items()
    }}
'''


class Mjlab(SimulatorFormat):
    """Python text with actuators, and events that draw within 90 % ranges."""

    key = "mjlab"
    title = "mjlab actuators and ranges (Python)"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the module and its notes."""
        kind, unlimited = (
            ("BuiltinPositionActuatorCfg", "None")
            if drives.has_gains
            else ("IdealPdActuatorCfg", 'float("inf")')  # it takes commanded efforts too
        )
        joints = "".join(
            f"    {re.escape(joint.name)!r}: ({joint.drive.kp or 0.0!r}, {joint.drive.kd or 0.0!r},"
            f" {_write_number(joint.limits.torque, unlimited)}, {joint.drive.armature or 0.0!r},"
            f" {joint.drive.coulomb or 0.0!r}, {joint.drive.viscous or 0.0!r}),\n"
            for joint in drives.plain.joints
        )
        text = TEXT.format(
            origin=drives.origin,
            kind=kind,
            joints=joints,
            delay=drives.delay,
            ranges=_write_ranges(drives),
        )
        return text, (
            *drives.left_out("mjlab", delay=True),
            *(["the delay is rounded to whole physics steps"] if drives.delay else []),
            "ranges of links are in an ensemble, which keeps links possible",
        )


def _write_ranges(drives: ExportedDrives) -> str:
    """Return the ranges of every field, from draws of the uncertainty, as Python text."""
    ensemble = draw_ensemble(drives.result, 200, rng=0)
    low, _, high = ensemble.quantiles
    place = {name: k for k, name in enumerate(ensemble.names)}
    text = ""
    for field, symbol in FIELDS.items():
        rows = "".join(
            f"        {re.escape(name)!r}: ({float(low[k])!r}, {float(high[k])!r}),\n"
            for number, name in enumerate(drives.model.joint_names, start=1)
            if (k := place.get(f"{symbol}{number}")) is not None and high[k] > 0.0
        )
        text += f"    {field!r}: {{\n{rows}    }},\n" if rows else ""
    return text


def _write_number(value: float, unlimited: str) -> str:
    return repr(float(value)) if np.isfinite(value) else unlimited


SIMULATOR_FORMATS.register("mjlab", Mjlab())
