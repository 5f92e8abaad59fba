"""What a motor adds that several joints turn: inertia, friction and the bend of cables."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import drive_term
from asbuilt.dynamics.drives.terms.elastic import HIGHEST, Cable
from asbuilt.dynamics.drives.terms.friction import Armature, Coulomb, Viscous


@drive_term
class MotorArmature(Armature):
    """Add `Iam s_dd` of the motor coordinate s to each joint that turns it, times its share.

    `s = T q` with the robot's motor coupling T. Where a motor moves one joint alone, its column is
    zero; `armature` has the same effect.
    """

    key = "motor_armature"
    position = 12
    symbols = ("Iam",)
    formula = "T^T Iam (T qdd)"
    of_motor = True
    default_for = ()
    tried_for = ()


@drive_term
class MotorViscous(Viscous):
    """Add `Fvm s_d` of the motor coordinate s to each joint that turns it, times its share.

    `s = T q` with the robot's motor coupling T. Where a motor moves one joint alone, its column is
    zero; `viscous` has the same effect.
    """

    key = "motor_viscous"
    title = "motor viscous friction"
    position = 24
    symbols = ("Fvm",)
    formula = "T^T Fvm (T qd)"
    of_motor = True
    default_for = ()


@drive_term
class MotorCoulomb(Coulomb):
    """Add `Fcm sign(s_d)` of the motor coordinate s to each joint that turns it, times its share.

    `s = T q` with the robot's motor coupling T. Where a motor moves one joint alone, its column is
    zero; `coulomb` has the same effect.
    """

    key = "motor_coulomb"
    title = "motor Coulomb friction"
    position = 36
    symbols = ("Fcm",)
    formula = "T^T Fcm sign(T qd)"
    of_motor = True
    default_for = ()


@drive_term
class MotorCable(Cable):
    """Add `sum_k Cs_k (s / pi)^k` of the far side s to each coordinate that turns it.

    `s = T q`, as for the other terms of the far side; `cable` is the same on the near side.
    """

    key = "motor_cable"
    position = 76
    symbols = tuple(f"C{k}s" for k in range(1, HIGHEST + 1))
    formula = "T^T sum_k Cks (T q / pi)^k, k <= order"
    of_motor = True
