"""Inertia of a rotor that several joints turn."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class MotorArmature(DriveTerm):
    """Add `Iam s_dd` of the motor coordinate s to each joint that turns it, times its share.

    `s = T q` with the robot's motor coupling T. Where a motor moves one joint alone, its column is
    zero; `armature` has the same effect.
    """

    key = "motor_armature"
    position = 12
    symbols = ("Iam",)
    columns = ("qdd",)
    formula = "T^T Iam (T qdd)"
    revolute_units = ("kg m^2",)
    prismatic_units = ("kg",)
    cause = "armature"
    non_negative = True
    ratio_powers = (2.0,)
    of_motor = True
