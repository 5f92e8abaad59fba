"""Viscous friction of a motor that several joints turn."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class MotorViscous(DriveTerm):
    """Add `Fvm s_d` to the torque of every joint that turns the motor, times its share.

    S is the motor's coordinate.

    `s = T q` with the robot's motor coupling T; where a motor moves one joint alone, `viscous` says
    the same and this column is zero.
    """

    key = "motor_viscous"
    position = 24
    symbols = ("Fvm",)
    revolute_units = ("N m s/rad",)
    prismatic_units = ("N s/m",)
    non_negative = True
    ratio_powers = (2.0,)
    formula = "T^T Fvm (T qd)"
    of_motor = True

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `s_d` of the motor."""
        out[0] = qd
