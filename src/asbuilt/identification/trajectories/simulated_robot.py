"""The robot that a simulation moves: links, drive terms and position servo."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import described_drive
from asbuilt.identification.result.as_built_parameters import as_built_parameters
from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRobot:
    """Hold a robot with n joints as a simulation needs it.

    Attributes
    ----------
    model
        The robot with the inertial parameters to simulate.
    drive
        Its drive terms.
    values
        Their parameters joint by joint, shape (n, columns_per_joint).
    servo
        The servo that follows a command; None if torques drive the robot.
    step
        Step [s] of the simulation whose first-order errors are undone; 0: as the steps have it.

    Notes
    -----
    The steps of `stepping.simulate`, and of MuJoCo, take velocities for those in the middle of a
    step: what drives them is early by half a step, and a damping D, which they have at the end,
    acts as `step / 2 D` more armature. With a signal that is later and an armature that is lower
    by as much, they become steps of the leapfrog method, whose errors are of second order (Hairer,
    Lubich & Wanner, Acta Numerica 12, 2003), so that the robot moves as with small steps. Coriolis
    forces, half a step early, and the damping of a servo at its torque limit keep first order.
    """

    model: RobotModel
    drive: DriveSet
    values: Array
    servo: PositionServo | None = None
    step: float = 0.0

    @property
    def stiffness(self) -> tuple[Array, Array, Array]:
        """Gains kp, kd and torque limit of the servo, three (n,); unknown gains are zero."""
        if self.servo is None:
            n = self.model.n_joints
            return np.zeros(n), np.zeros(n), np.full(n, np.inf)
        kp, kd = (np.nan_to_num(np.array(x)) for x in (self.servo.kp, self.servo.kd))
        return kp, kd, np.array(self.servo.torque_limit)

    @property
    def deviations(self) -> tuple[Array, Array]:
        """Deadband of the servo, and how much its torque limit falls per speed, two (n,)."""
        if self.servo is None:
            return np.zeros(self.model.n_joints), np.zeros(self.model.n_joints)
        return np.nan_to_num(np.array(self.servo.deadband)), self.servo.falling

    @property
    def lead(self) -> Array:
        """Lead of the servo [s], shape (n,)."""
        return np.zeros(self.model.n_joints) if self.servo is None else self.servo.leads

    @property
    def delay(self) -> float:
        """Delay of what drives the simulation [s]."""
        late = (self.servo.delay or 0.0) if self.servo is not None else 0.0
        return late + 0.5 * self.step

    def centred(self, step: float) -> SimulatedRobot:
        """Return the robot for steps [s] whose first-order errors are undone."""
        return replace(self, step=step)

    def with_servo(self, servo: PositionServo | None) -> SimulatedRobot:
        """Return the robot with another servo."""
        return replace(self, servo=servo)


def build_robot_as_built(
    result: IdentificationResult, servo: PositionServo | None = None
) -> SimulatedRobot:
    """Return the robot with the standard parameters closest to CAD that a result supports."""
    chi, links = as_built_parameters(result).parameters, 10 * result.model.n_links
    return SimulatedRobot(
        result.model.with_parameters(chi[:links]),
        result.base.drive,
        chi[links:].reshape(result.model.n_joints, -1),
        servo,
    )


def build_robot_as_described(
    model: RobotModel, servo: PositionServo | None = None
) -> SimulatedRobot:
    """Return the robot with the inertias, drive terms and values of its description."""
    drive, values = described_drive(model)
    return SimulatedRobot(model, drive, values.reshape(model.n_joints, -1), servo)
