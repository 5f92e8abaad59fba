"""Coulomb friction of different size in the two directions."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class AsymmetricCoulomb(DriveTerm):
    """Add `Fcp` where qd > 0 and `-Fcn` where qd < 0.

    It equals Coulomb friction (Fcp + Fcn) / 2 and an offset (Fcp - Fcn) / 2 that is zero at
    standstill. It replaces `coulomb`.
    """

    key = "asymmetric_coulomb"
    title = "asymmetric Coulomb friction"
    position = 32
    symbols = ("Fcp", "Fcn")
    columns = ("maximum(sign(qd), 0)", "minimum(sign(qd), 0)")
    formula = "Fcp [qd > 0] - Fcn [qd < 0]"
    revolute_units = ("N m", "N m")
    prismatic_units = ("N", "N")
    stands_for = "coulomb"
    non_negative = True

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return halves of `sign(qd)` and 1, on which `coulomb` and `offset` are dependent."""
        return ({"sign(qd)": 0.5, "1": 0.5}, {"sign(qd)": 0.5, "1": -0.5})
