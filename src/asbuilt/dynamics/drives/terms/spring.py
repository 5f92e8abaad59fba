"""Spring about the joint axis, with torque linear in the position."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from asbuilt.dynamics.drives.term import (
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


@drive_term
class Spring(DriveTerm):
    """Add `Ks (q - rest)`; with an offset, the spring is at rest at `q = rest - Fo / Ks`.

    Cables that coil about an axis have this effect. No link has: the potential energy of gravity
    has no term quadratic in a position.
    """

    rest: NonlinearValue = None

    key = "spring"
    position = 70
    symbols = ("Ks",)
    columns = ("q-rest",)
    formula = "Ks (q - rest)"
    revolute_units = ("N m/rad",)
    prismatic_units = ("N/m",)
    nonlinear = (NonlinearParameter("rest", 0.0, -1e3, 1e3, "rad or m", fitted=False),)
    by_construction = True
    ratio_powers = (2.0,)

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the position, and a constant where the spring is at rest elsewhere than at 0."""
        rest = self.value("rest")
        found: Mapping[Hashable, float] = {"q": 1.0, "1": -rest} if rest else {"q": 1.0}
        return (found,)
