"""Friction with the square of velocity, against the motion."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class Quadratic(DriveTerm):
    """Add `Fq qd |qd|`."""

    key = "quadratic"
    position = 52
    symbols = ("Fq",)
    revolute_units = ("N m s^2/rad^2",)
    prismatic_units = ("N s^2/m^2",)
    ratio_powers = (3.0,)
    formula = "Fq qd |qd|"

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `qd |qd|`."""
        np.multiply(qd, np.abs(qd), out=out[0])

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `qd |qd|`."""
        return ({"qd |qd|": 1.0},)
