"""Parameters of BAM (better actuator models), one set for each joint, as JSON.

BAM's load is `|tau_m - tau_e|` with the motor torque and the torque of the load, ours the
rigid-body torque L. In motion `tau_e = -L` and `tau_m = L + f sign(qd)` with the friction f, so
`f = |Km tau_m - Ke tau_e|` gives `f = (Km + Ke) |L| / (1 - Km)` where the motor drives and
`f = (Km + Ke) |L| / (1 + Km)` where the load drives.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description import Joint
from asbuilt.writers import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
)

LOADED = ("load_friction", "load_stribeck")
DIRECTIONAL = ("directional_load_friction", "directional_load_stribeck")
QUADRATIC = "quadratic_load_stribeck"
FADING = ("stribeck", "load_stribeck", "directional_load_stribeck", QUADRATIC)
CARRIED = frozenset((*LOADED, *DIRECTIONAL, *FADING))


class Bam(SimulatorFormat):
    """A JSON object with one BAM parameter set for each joint, by name."""

    key = "bam"
    title = "BAM parameters (JSON), models m1 to m6"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the parameter sets and notes."""
        sets = {joint.name: choose_bam_parameters(joint) for joint in drives.plain.joints}
        late = {"command_delay": drives.delay} if drives.delay else {}
        negative = sorted(
            {
                key
                for parameters in sets.values()
                for key, value in parameters.items()
                if isinstance(value, float) and value < 0.0
            }
        )
        uneven = [joint.name for joint in drives.plain.joints if _is_uneven(joint)]
        own = {
            "BAM also wants `actuator` (the class of the motor) and the motor's own numbers, `kt`,"
            " `R` and others, which no recording of joint torque holds: add them, then"
            " load_model_from_dict(sets[joint])": True,
            "command_delay [s] is no parameter of BAM, whose loader passes over it: delay the"
            " commands in its simulation": bool(late),
            "BAM has its own law of the servo: kp and kd are not in its file": drives.has_gains,
            "BAM's own fits keep every parameter at zero or above; below zero at some joints are"
            f" {', '.join(negative)}": bool(negative),
            "BAM has one Stribeck velocity and power for all terms: the first term's is"
            f" written for {', '.join(uneven)}": bool(uneven),
        }
        text = (
            json.dumps({name: parameters | late for name, parameters in sets.items()}, indent=2)
            + "\n"
        )
        return text, (
            *drives.left_out("BAM", carried=CARRIED, delay=True, gains=False),
            *(note for note, holds in own.items() if holds),
        )


def choose_bam_parameters(joint: Joint) -> dict[str, Any]:
    """Return the BAM parameters of one joint: the smallest model that has its drive terms."""
    drive = joint.drive
    terms = joint.drive.terms
    fading, loaded, directional = (
        [terms[key] for key in keys if key in terms]
        for keys in (FADING, LOADED, (*DIRECTIONAL, QUADRATIC))
    )
    number = 6 if QUADRATIC in terms else 5 if directional else 1 + bool(fading) + 2 * bool(loaded)
    found: dict[str, Any] = {
        "model": f"m{number}",
        "armature": drive.armature or 0.0,
        "friction_base": drive.coulomb or 0.0,
        "friction_viscous": drive.viscous or 0.0,
    }
    if number not in (1, 3):
        found["friction_stribeck"] = terms.get("stribeck", {}).get("Fs", 0.0)
    if fading:
        found |= {"dtheta_stribeck": fading[0]["velocity"], "alpha": fading[0]["power"]}
    if directional:
        found |= _split_by_direction(terms)
    elif loaded:
        base = terms.get("load_friction", {}).get("Fl", 0.0)
        rest = terms.get("load_stribeck", {}).get("Fls", 0.0)
        found["load_friction_base"] = load_coefficient(base)
        if fading:
            found["load_friction_stribeck"] = load_coefficient(base + rest) - load_coefficient(base)
    return found


def load_coefficient(friction: float) -> float:
    """Return K with `friction = 2 K / (1 - K^2)`, the mean of both directions."""
    return float((np.sqrt(1.0 + friction**2) - 1.0) / friction) if friction else 0.0


def derive_directional_coefficients(driving: float, driven: float) -> tuple[float, float]:
    """Return Km and Ke of the friction per load where the motor drives and where the load does."""
    whole = driving + driven
    if whole == 0.0:
        return 0.0, 0.0
    motor = (driving - driven) / whole
    return motor, 2.0 * driving * driven / whole - motor


def _split_by_direction(terms: Any) -> dict[str, float]:
    moving, slow, (both,) = (
        [terms.get(key, {}).get(symbol, 0.0) for symbol in symbols]
        for key, symbols in (
            (DIRECTIONAL[0], ("Flm", "Fle")),
            (DIRECTIONAL[1], ("Flsm", "Flse")),
            ("load_friction", ("Fl",)),
        )
    )
    motor, external = derive_directional_coefficients(*(x + both for x in moving))
    at_rest = derive_directional_coefficients(
        *(x + both + z for x, z in zip(moving, slow, strict=True))
    )
    found = {
        "load_friction_motor": motor,
        "load_friction_external": external,
        "load_friction_motor_stribeck": at_rest[0] - motor,
        "load_friction_external_stribeck": at_rest[1] - external,
    }
    if QUADRATIC in terms:
        found["load_friction_external_quad"] = terms[QUADRATIC]["Flqm"]
        found["load_friction_motor_quad"] = terms[QUADRATIC]["Flqe"]
    return found


def _is_uneven(joint: Joint) -> bool:
    """Whether the fading terms of a joint have different velocities or powers."""
    fading = [joint.drive.terms[key] for key in FADING if key in joint.drive.terms]
    return len({(term["velocity"], term["power"]) for term in fading}) > 1


SIMULATOR_FORMATS.register("bam", Bam())
