"""Friction that grows with a power of speed."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, NonlinearParameter, NonlinearValue

SPECIAL = {0.0: "sign qd", 1.0: "qd", 2.0: "qd |qd|", 3.0: "qd^3"}
"""Exponents with which the term equals another."""


@dataclass(frozen=True, slots=True)
class Power(DriveTerm):
    """Add `Fp |qd|^exponent sign(qd)`.

    Rolling bearings and grease that thins with shear (exponent 2/3 and less), churned oil (towards
    2).

    Source: Palmgren, Grundlagen der Waelzlagertechnik, 1957: the torque of a lubricated bearing
    without load grows with the 2/3 power of speed. It stands for `viscous`.
    """

    exponent: NonlinearValue = None

    key = "power"
    position = 50
    symbols = ("Fp",)
    revolute_units = ("N m (s/rad)^a",)
    prismatic_units = ("N (s/m)^a",)
    tried_for = ALL_SOURCES
    stands_for = "viscous"
    formula = "Fp |qd|^exponent sign(qd)"
    nonlinear = (NonlinearParameter("exponent", 0.5, 0.0, 4.0, "", credible=(0.25, 2.5)),)

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `|qd|^exponent sign(qd)`."""
        out[0] = np.sign(qd) * np.abs(qd) ** self.value("exponent")

    def powers_of_ratio(self) -> tuple[float, ...]:
        """Return 1 + exponent."""
        return (1.0 + self.value("exponent"),)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the power; 0, 1, 2 and 3 are those of other terms."""
        exponent = self.value("exponent")
        return ({SPECIAL.get(exponent, (self.key, exponent)): 1.0},)
