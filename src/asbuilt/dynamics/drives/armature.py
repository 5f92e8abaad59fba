"""Inertia of the rotor and the gears, reflected to the joint."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.dynamics.drives.term import Array, DriveTerm


@dataclass(frozen=True, slots=True)
class Armature(DriveTerm):
    """Add `Ia qdd`; the gyroscopic effect of the spinning rotor is neglected."""

    key = "armature"
    position = 10
    letters = ("Ia",)
    revolute_units = ("kg m^2",)
    prismatic_units = ("kg",)

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `qdd`."""
        out[0] = qdd
