"""Coulomb friction of a motor that several joints turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import DriveTerm


@dataclass(frozen=True, slots=True)
class MotorCoulomb(DriveTerm):
    """Add `Fcm sign(s_d)` to the torque of every joint that turns the motor, times its share.

    S is the motor's coordinate.

    `s = T q` with the robot's motor coupling T; where a motor moves one joint alone, `coulomb` says
    the same and this column is zero.
    """

    key = "motor_coulomb"
    position = 36
    symbols = ("Fcm",)
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    non_negative = True
    formula = "T^T Fcm sign(T qd)"
    of_motor = True

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `sign(s_d)` of the motor."""
        np.sign(qd, out=out[0])
