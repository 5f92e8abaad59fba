"""A spring about the joint's axis, torque linear in the joint's position."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class Spring(DriveTerm):
    """Add `Ks q`; with an offset, the spring rests at `q = -Fo / Ks`.

    Cables that coil about an axis act like one.
    """

    key = "spring"
    position = 70
    symbols = ("Ks",)
    revolute_units = ("N m/rad",)
    prismatic_units = ("N/m",)
    by_construction = True
    ratio_powers = (2.0,)
    formula = "Ks q"

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `q`."""
        out[0] = q

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `q`, which no link imitates.

        The potential energy of gravity holds no square of a position.
        """
        return ({"q": 1.0},)
