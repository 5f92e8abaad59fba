"""Spring about the joint axis, with torque linear in the position."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class Spring(DriveTerm):
    """Add `Ks q`; with an offset, the spring is at rest at `q = -Fo / Ks`.

    Cables that coil about an axis have this effect. No link has: the potential energy of gravity
    has no term quadratic in a position.
    """

    key = "spring"
    position = 70
    symbols = ("Ks",)
    columns = ("q",)
    formula = "Ks q"
    revolute_units = ("N m/rad",)
    prismatic_units = ("N/m",)
    by_construction = True
    ratio_powers = (2.0,)
