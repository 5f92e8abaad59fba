"""Constant torque: a sensor or amplifier offset, or the asymmetry of Coulomb friction."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm


@dataclass(frozen=True, slots=True)
class Offset(DriveTerm):
    """Add `Fo`."""

    key = "offset"
    position = 90
    symbols = ("Fo",)
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    turns_over = True
    formula = "Fo"
    default_for = ALL_SOURCES

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write 1."""
        out[0] = 1.0

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the constant, as the weight on a joint that slides at a constant slope."""
        return ({"1": 1.0},)
