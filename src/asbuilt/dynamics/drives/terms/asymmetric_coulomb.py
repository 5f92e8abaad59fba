"""Coulomb friction of different size in the two directions."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class AsymmetricCoulomb(DriveTerm):
    """Add `Fcp` where qd > 0 and `-Fcn` where qd < 0.

    Coulomb friction (Fcp + Fcn) / 2 with an offset (Fcp - Fcn) / 2 that rests at standstill.
    """

    key = "asymmetric_coulomb"
    position = 32
    symbols = ("Fcp", "Fcn")
    revolute_units = ("N m", "N m")
    prismatic_units = ("N", "N")
    stands_for = "coulomb"
    non_negative = True
    formula = "Fcp [qd > 0] - Fcn [qd < 0]"

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `[qd > 0]` and `-[qd < 0]`."""
        out[0] = qd > 0
        out[1] = -1.0 * (qd < 0)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return halves of `sign qd` and of the constant.

        Beside `coulomb` or `offset` only sums can be told.
        """
        return ({"sign qd": 0.5, "1": 0.5}, {"sign qd": 0.5, "1": -0.5})
