"""Inertia of rotor and gears, reflected to the joint."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import MOTOR_SOURCES, DriveTerm, drive_term


@drive_term
class Armature(DriveTerm):
    """Add `Ia qdd`; gyroscopic torques of the rotor are neglected.

    A sensor between gear and joint does not measure it.
    """

    key = "armature"
    position = 10
    symbols = ("Ia",)
    columns = ("qdd",)
    formula = "Ia qdd"
    revolute_units = ("kg m^2",)
    prismatic_units = ("kg",)
    cause = "armature"
    non_negative = True
    ratio_powers = (2.0,)
    default_for = MOTOR_SOURCES
    tried_for = ("unknown",)
