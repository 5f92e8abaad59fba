"""Viscous friction of different size in the two directions."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, drive_term


@drive_term
class AsymmetricViscous(DriveTerm):
    """Add `Fvp qd` where qd > 0 and `Fvn qd` where qd < 0. It replaces `viscous`."""

    key = "asymmetric_viscous"
    title = "asymmetric viscous friction"
    position = 22
    symbols = ("Fvp", "Fvn")
    columns = ("maximum(qd, 0)", "minimum(qd, 0)")
    formula = "Fvp max(qd, 0) + Fvn min(qd, 0)"
    revolute_units = ("N m s/rad", "N m s/rad")
    prismatic_units = ("N s/m", "N s/m")
    tried_for = ALL_SOURCES
    stands_for = "viscous"
    non_negative = True
    ratio_powers = (2.0, 2.0)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return halves of `qd` and `abs(qd)`, so that `viscous` is dependent on them."""
        return ({"qd": 0.5, "abs(qd)": 0.5}, {"qd": 0.5, "abs(qd)": -0.5})
