"""What friction near standstill exceeds Coulomb friction by, fading with speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.dynamics.drives.term import Array, DriveTerm, Shape, ShapeValue


@dataclass(frozen=True, slots=True)
class Stribeck(DriveTerm):
    """Add `Fs exp(-|qd / velocity|^power) sign(qd)` to Coulomb friction.

    Source: Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994, section 2.
    """

    velocity: ShapeValue = None
    power: ShapeValue = None

    key = "stribeck"
    position = 40
    letters = ("Fs",)
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    formula = "Fs exp(-|qd/velocity|^power) sign(qd)"
    shapes = (
        Shape("velocity", 0.1, 1e-3, 5.0, "rad/s", typical=2.0, speed=True),
        Shape("power", 2.0, 0.5, 4.0, "", fitted=False, typical=2.0),
    )

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `exp(-|qd / velocity|^power) sign(qd)`."""
        out[0] = np.sign(qd) * np.exp(-(np.abs(qd / self.value("velocity")) ** self.value("power")))
