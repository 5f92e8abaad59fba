"""Inertia of a rotor that several joints turn."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class MotorArmature(DriveTerm):
    """Add `Iam s_dd` to the torque of every joint that turns the motor, times its share.

    S is the motor's coordinate.

    `s = T q` with the robot's motor coupling T; where a motor moves one joint alone, `armature`
    says the same and this column is zero.
    """

    key = "motor_armature"
    position = 12
    symbols = ("Iam",)
    revolute_units = ("kg m^2",)
    prismatic_units = ("kg",)
    non_negative = True
    ratio_powers = (2.0,)
    formula = "T^T Iam (T qdd)"
    of_motor = True

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `s_dd` of the motor."""
        out[0] = qdd
