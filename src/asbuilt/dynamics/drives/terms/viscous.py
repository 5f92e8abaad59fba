"""Friction in proportion to velocity."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm


@dataclass(frozen=True, slots=True)
class Viscous(DriveTerm):
    """Add `Fv qd`."""

    key = "viscous"
    position = 20
    symbols = ("Fv",)
    revolute_units = ("N m s/rad",)
    prismatic_units = ("N s/m",)
    non_negative = True
    ratio_powers = (2.0,)
    formula = "Fv qd"
    default_for = ALL_SOURCES

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `qd`."""
        out[0] = qd

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `qd`."""
        return ({"qd": 1.0},)
