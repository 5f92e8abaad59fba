"""Inertia of the rotor and the gears, reflected to the joint."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import MOTOR_SOURCES, DriveTerm


@dataclass(frozen=True, slots=True)
class Armature(DriveTerm):
    """Add `Ia qdd`; the gyroscopic effect of the spinning rotor is neglected.

    A sensor behind the gear does not feel it.
    """

    key = "armature"
    position = 10
    symbols = ("Ia",)
    revolute_units = ("kg m^2",)
    prismatic_units = ("kg",)
    non_negative = True
    ratio_powers = (2.0,)
    formula = "Ia qdd"
    default_for = MOTOR_SOURCES
    tried_for = ("unknown",)

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `qdd`."""
        out[0] = qdd

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `qdd`, as an inertia about the joint's axis."""
        return ({"qdd": 1.0},)
