"""Parameters of BAM (better actuator models), one set for each joint, as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from asbuilt.description.model import Joint
from asbuilt.writers.models.simulators.simulator_format import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
)

NAMES = {
    ("stribeck", "Fs"): "friction_stribeck",
    ("stribeck", "velocity"): "dtheta_stribeck",
    ("stribeck", "power"): "alpha",
    ("load_friction", "Fl"): "load_friction_base",
    ("load_stribeck", "Fls"): "load_friction_stribeck",
    ("load_stribeck", "velocity"): "dtheta_stribeck",
    ("load_stribeck", "power"): "alpha",
}
"""Drive term and number, and what BAM calls it."""
CARRIED = frozenset(key for key, _ in NAMES)


class Bam(SimulatorFormat):
    """A JSON object with one BAM parameter set for each joint, by name."""

    key = "bam"
    title = "BAM parameters (JSON), models m1 to m4"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the parameter sets and notes."""
        sets = {joint.name: _set(joint) for joint in drives.plain.joints}
        for each in sets.values():
            if drives.delay:
                each["command_delay"] = drives.delay
        notes = (
            *drives.left_out("BAM", carried=CARRIED, delay=True),
            "BAM also wants `actuator` (the class of the motor) and the motor's `kt` and `R`, which"
            " no recording of joint torque holds: add them, then load_model_from_dict(sets[joint])",
        )
        if drives.has_gains:
            notes = (*notes, "BAM has its own law of the servo: kp and kd are not in its file")
        return json.dumps(sets, indent=2) + "\n", notes


def _set(joint: Joint) -> dict[str, Any]:
    drive = joint.drive
    found: dict[str, Any] = {
        "model": bam_model(set(drive.terms)),
        "armature": drive.armature or 0.0,
        "friction_base": drive.coulomb or 0.0,
        "friction_viscous": drive.viscous or 0.0,
    }
    for (term, symbol), name in NAMES.items():
        if term in drive.terms and symbol in drive.terms[term]:
            found[name] = drive.terms[term][symbol]
    if found["model"] == "m4":
        found = {"load_friction_base": 0.0, "friction_stribeck": 0.0} | found
    return found


def bam_model(terms: set[str]) -> str:
    """Return the smallest of the models m1 to m4 that has these drive terms."""
    loaded = bool(terms & {"load_friction", "load_stribeck"})
    fading = bool(terms & {"stribeck", "load_stribeck"})
    return {(False, False): "m1", (False, True): "m2", (True, False): "m3", (True, True): "m4"}[
        loaded, fading
    ]


SIMULATOR_FORMATS.register("bam", Bam())
