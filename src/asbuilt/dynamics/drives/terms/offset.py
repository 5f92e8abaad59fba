"""Constant torque: offset of a sensor or amplifier, or asymmetric Coulomb friction."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, drive_term


@drive_term
class Offset(DriveTerm):
    """Add `Fo`."""

    key = "offset"
    title = "torque offset"
    position = 90
    symbols = ("Fo",)
    columns = ("1",)
    formula = "Fo"
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    cause = "offset"
    turns_over = True
    default_for = ALL_SOURCES
