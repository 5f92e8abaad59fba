"""Viscous friction of a motor that several joints turn."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class MotorViscous(DriveTerm):
    """Add `Fvm s_d` of the motor coordinate s to each joint that turns it, times its share.

    `s = T q` with the robot's motor coupling T. Where a motor moves one joint alone, its column is
    zero; `viscous` has the same effect.
    """

    key = "motor_viscous"
    title = "motor viscous friction"
    position = 24
    symbols = ("Fvm",)
    columns = ("qd",)
    formula = "T^T Fvm (T qd)"
    revolute_units = ("N m s/rad",)
    prismatic_units = ("N s/m",)
    cause = "friction"
    non_negative = True
    ratio_powers = (2.0,)
    of_motor = True
