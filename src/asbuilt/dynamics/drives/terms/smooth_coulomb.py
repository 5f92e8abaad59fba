"""Coulomb friction that changes sign over a width of velocity instead of at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, NonlinearParameter, NonlinearValue


@dataclass(frozen=True, slots=True)
class SmoothCoulomb(DriveTerm):
    """Add `Fct tanh(qd / width)`; it stands for `coulomb`, and beside it for a rounded part of it.

    The width is that of the change of sign, where bristles bend before surfaces slide and logged
    velocities lie in their noise; fits look up to a tenth of the top speed.
    """

    width: NonlinearValue = None

    key = "smooth_coulomb"
    position = 34
    symbols = ("Fct",)
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    tried_for = ALL_SOURCES
    stands_for = "coulomb"
    non_negative = True
    formula = "Fct tanh(qd / width)"
    nonlinear = (
        NonlinearParameter(
            "width", 0.02, 1e-4, 2.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
    )

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `tanh(qd / width)`."""
        np.tanh(qd / self.value("width"), out=out[0])
