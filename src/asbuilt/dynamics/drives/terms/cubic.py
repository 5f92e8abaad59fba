"""Friction with the third power of velocity."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class Cubic(DriveTerm):
    """Add `Fk qd^3`; negative beside viscous friction that levels off at speed."""

    key = "cubic"
    position = 54
    symbols = ("Fk",)
    revolute_units = ("N m s^3/rad^3",)
    prismatic_units = ("N s^3/m^3",)
    ratio_powers = (4.0,)
    formula = "Fk qd^3"

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `qd^3`."""
        out[0] = qd * qd * qd

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `qd^3`."""
        return ({"qd^3": 1.0},)
