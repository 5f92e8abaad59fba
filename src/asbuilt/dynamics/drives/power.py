"""Friction that grows with a power of speed."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.dynamics.drives.term import Array, DriveTerm, Shape, ShapeValue

SPECIAL = {0.0: "sign qd", 1.0: "qd", 2.0: "qd |qd|", 3.0: "qd^3"}
"""Exponents with which the term equals another."""


@dataclass(frozen=True, slots=True)
class Power(DriveTerm):
    """Add `Fp |qd|^exponent sign(qd)`: the shear thinning of grease (exponent below 1), or drag of air (2)."""

    exponent: ShapeValue = None

    key = "power"
    position = 50
    letters = ("Fp",)
    revolute_units = ("N m (s/rad)^a",)
    prismatic_units = ("N (s/m)^a",)
    formula = "Fp |qd|^exponent sign(qd)"
    shapes = (Shape("exponent", 0.5, 0.0, 4.0, ""),)

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `|qd|^exponent sign(qd)`."""
        out[0] = np.sign(qd) * np.abs(qd) ** self.value("exponent")

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the power; 0, 1, 2 and 3 are those of other terms."""
        exponent = self.value("exponent")
        return ({SPECIAL.get(exponent, (self.key, exponent)): 1.0},)
