"""Friction with the third power of velocity."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class Cubic(DriveTerm):
    """Add `Fk qd^3`; negative beside viscous friction that levels off at high speed."""

    key = "cubic"
    title = "cubic friction"
    position = 54
    symbols = ("Fk",)
    columns = ("qd*qd*qd",)
    formula = "Fk qd^3"
    revolute_units = ("N m s^3/rad^3",)
    prismatic_units = ("N s^3/m^3",)
    ratio_powers = (4.0,)
