"""Friction of constant size against the motion."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm


@dataclass(frozen=True, slots=True)
class Coulomb(DriveTerm):
    """Add `Fc sign(qd)`, exactly 0 at standstill."""

    key = "coulomb"
    position = 30
    symbols = ("Fc",)
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    non_negative = True
    formula = "Fc sign(qd)"
    default_for = ALL_SOURCES

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `sign(qd)`."""
        np.sign(qd, out=out[0])

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `sign qd`."""
        return ({"sign qd": 1.0},)
