"""A gravity balancer: a counterweight, or an ideal spring balancer, that turns with the joint
against a fixed direction.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class Balancer(DriveTerm):
    """Add `Bs sin(q) + Bc cos(q)`.

    Where gravity looks the same from the parent link at all times, a first moment of the link does
    just that.
    """

    key = "balancer"
    position = 80
    symbols = ("Bs", "Bc")
    revolute_units = ("N m", "N m")
    prismatic_units = ("N", "N")
    by_construction = True
    turns_over = True
    formula = "Bs sin(q) + Bc cos(q)"

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `sin(q)` and `cos(q)`."""
        np.sin(q, out=out[0])
        np.cos(q, out=out[1])

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return `sin q` and `cos q`."""
        return ({"sin q": 1.0}, {"cos q": 1.0})
