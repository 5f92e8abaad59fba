"""Constant torque: a sensor or amplifier offset, or the asymmetry of Coulomb friction."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.dynamics.drives.term import Array, DriveTerm


@dataclass(frozen=True, slots=True)
class Offset(DriveTerm):
    """Add `Fo`."""

    key = "offset"
    position = 40
    letters = ("Fo",)
    revolute_units = ("N m",)
    prismatic_units = ("N",)

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write 1."""
        out[0] = 1.0
