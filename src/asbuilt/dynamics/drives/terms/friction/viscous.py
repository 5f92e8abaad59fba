"""Friction in proportion to velocity."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, drive_term


@drive_term
class Viscous(DriveTerm):
    """Add `Fv qd`."""

    key = "viscous"
    title = "viscous friction"
    position = 20
    symbols = ("Fv",)
    columns = ("qd",)
    formula = "Fv qd"
    revolute_units = ("N m s/rad",)
    prismatic_units = ("N s/m",)
    cause = "friction"
    non_negative = True
    ratio_powers = (2.0,)
    default_for = ALL_SOURCES
