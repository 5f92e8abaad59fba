"""Coulomb friction of a motor that several joints turn."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class MotorCoulomb(DriveTerm):
    """Add `Fcm sign(s_d)` of the motor coordinate s to each joint that turns it, times its share.

    `s = T q` with the robot's motor coupling T. Where a motor moves one joint alone, its column is
    zero; `coulomb` has the same effect.
    """

    key = "motor_coulomb"
    title = "motor Coulomb friction"
    position = 36
    symbols = ("Fcm",)
    columns = ("sign(qd)",)
    formula = "T^T Fcm sign(T qd)"
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    cause = "friction"
    non_negative = True
    of_motor = True
