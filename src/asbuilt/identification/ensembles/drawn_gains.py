"""Draws of the gains and the delay of a position servo from their errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import PositionServo
from asbuilt.findings import join_names
from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True, eq=False)
class DrawnGains:
    """Hold what is drawn of the law of the drives: nothing, N times, where torques were measured.

    Draws are columns beside those of the robot.
    """

    n: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return ()

    def list_units(self, model: RobotModel) -> tuple[str, ...]:
        """Return the units of the columns."""
        return ()

    def list_joints(self, model: RobotModel) -> tuple[str, ...]:
        """Return the joint of each column, "all" of one that concerns all."""
        return ()

    @property
    def table(self) -> Array:
        """The columns of every draw, shape (N, columns)."""
        return np.empty((self.n, 0))

    @property
    def middle(self) -> Array:
        """The same as identified, shape (columns,)."""
        return np.empty(0)

    def law(self, draw: int) -> PositionServo | None:
        """Return the law of a draw, counted from 0; None without one."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class DrawnServo(DrawnGains):
    """Hold N draws of a position servo, equally probable.

    Attributes
    ----------
    servo
        The servo as identified.
    kp, kd
        Gains (N, n).
    delay
        Delay [s], shape (N,).
    """

    servo: PositionServo
    kp: Array
    kd: Array
    delay: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns: `kp1 ... kd1 ... delay`."""
        numbers = range(1, self.kp.shape[1] + 1)
        return (*(f"kp{k}" for k in numbers), *(f"kd{k}" for k in numbers), "delay")

    def list_units(self, model: RobotModel) -> tuple[str, ...]:
        """Return the units of the columns."""
        turning = [joint.is_revolute for joint in model.joints]
        return (
            *("N m/rad" if revolute else "N/m" for revolute in turning),
            *("N m s/rad" if revolute else "N s/m" for revolute in turning),
            "s",
        )

    def list_joints(self, model: RobotModel) -> tuple[str, ...]:
        """Return the joint of each column, "all" of the delay."""
        return (*model.joint_names, *model.joint_names, "all")

    @property
    def table(self) -> Array:
        """The columns of every draw, shape (N, columns)."""
        return np.column_stack([self.kp, self.kd, self.delay])

    @property
    def middle(self) -> Array:
        """The same of the servo as identified, shape (columns,)."""
        gains = np.nan_to_num(np.concatenate([self.servo.kp, self.servo.kd]))
        return np.append(gains, self.servo.delay or 0.0)

    def law(self, draw: int) -> PositionServo:
        """Return the servo of a draw, counted from 0."""
        return replace(
            self.servo,
            kp=tuple(self.kp[draw].tolist()),
            kd=tuple(self.kd[draw].tolist()),
            delay=float(self.delay[draw]),
        )


def draw_gains(
    result: IdentificationResult, n: int, random: np.random.Generator
) -> tuple[DrawnGains, Array | None, list[str]]:
    """Draw the servo of a result: stiffness and delay with their errors, damping as identified.

    Returns the draws, factors (N, 1 or n) by which the torques of joints follow the stiffness,
    None where torques were measured, and what the draws leave out.
    """
    servo = result.servo
    errors = result.servo_errors
    if servo is None:
        return DrawnGains(n), None, []
    kp, factors, notes = _draw_stiffness(result, servo, n, random)
    kd = np.tile(np.nan_to_num(np.array(servo.kd)), (n, 1))
    late = (0.0 if errors is None else errors.delay) * random.normal(size=n)
    delay = np.maximum((servo.delay or 0.0) + late, 0.0)
    if errors is not None and errors.lead:
        notes.append(
            "the lead of the servo is the identified one in every draw; its standard error is"
            f" {1e3 * errors.lead:.2g} ms"
        )
    return DrawnServo(n, servo, kp, kd, delay), factors, notes


def _draw_stiffness(
    result: IdentificationResult, servo: PositionServo, n: int, random: np.random.Generator
) -> tuple[Array, Array, list[str]]:
    """Return stiffnesses (N, n_joints), their factors, and notes."""
    errors = result.servo_errors
    kp = np.nan_to_num(np.array(servo.kp))
    joints = result.model.n_joints
    own = np.zeros(joints) if errors is None or not errors.kp else np.array(errors.kp)
    relative = np.divide(own, kp, out=np.zeros(joints), where=kp > 0)
    unknown = ~np.isfinite(relative)
    relative[unknown] = 0.0
    shared = errors is not None and errors.shared
    factors = np.exp(relative * random.normal(size=(n, 1 if shared else joints)))
    notes = []
    if np.any(unknown):
        names = [name for name, each in zip(result.joint_names, unknown, strict=True) if each]
        notes.append(
            f"the stiffness of the servo of {join_names(names)} is undetermined: every draw has the"
            " same one, and only ratios to it mean something"
        )
    return kp * factors, factors, notes
