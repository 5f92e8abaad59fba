"""Friction with the square of velocity, against the motion."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, drive_term


@drive_term
class Quadratic(DriveTerm):
    """Add `Fq qd |qd|`."""

    key = "quadratic"
    title = "quadratic friction"
    position = 52
    symbols = ("Fq",)
    columns = ("qd*abs(qd)",)
    formula = "Fq qd |qd|"
    revolute_units = ("N m s^2/rad^2",)
    prismatic_units = ("N s^2/m^2",)
    tried_for = ALL_SOURCES
    ratio_powers = (3.0,)
