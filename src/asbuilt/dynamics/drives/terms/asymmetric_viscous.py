"""Viscous friction of different size in the two directions."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm


@dataclass(frozen=True, slots=True)
class AsymmetricViscous(DriveTerm):
    """Add `Fvp qd` where qd > 0 and `Fvn qd` where qd < 0."""

    key = "asymmetric_viscous"
    position = 22
    symbols = ("Fvp", "Fvn")
    revolute_units = ("N m s/rad", "N m s/rad")
    prismatic_units = ("N s/m", "N s/m")
    tried_for = ALL_SOURCES
    stands_for = "viscous"
    non_negative = True
    ratio_powers = (2.0, 2.0)
    formula = "Fvp max(qd, 0) + Fvn min(qd, 0)"

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `max(qd, 0)` and `min(qd, 0)`."""
        np.maximum(qd, 0.0, out=out[0])
        np.minimum(qd, 0.0, out=out[1])

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return halves of `qd` and of its size: beside `viscous` only sums can be told."""
        return ({"qd": 0.5, "|qd|": 0.5}, {"qd": 0.5, "|qd|": -0.5})
