"""What enters the balance of momentum of a robot besides the torques of the drives."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.torque import described_drive, drive_torque
from asbuilt.dynamics.momentum import Momentum
from asbuilt.dynamics.torque_model import TorqueModel
from asbuilt.identification.result.result import IdentificationResult


class MomentumBalance:
    """Evaluate `p`, `b` and the friction f of `dp/dt = tau + b - f + tau_ext`.

    `p = (M(q) + A) qd` with the constant armature A of the drives, rotors that several joints turn
    included, and `b = C(q, qd)^T qd - g(q)`. Friction `f(q, qd)` takes its load at `qdd = 0`; it is
    given at both ends of the velocities `qd -+ velocity_error` that the logged one stands for.

    Parameters
    ----------
    torque
        The robot with its drives.
    velocity_error
        Largest error (n,) of a logged velocity [rad/s or m/s].
    """

    def __init__(self, torque: TorqueModel, velocity_error: Array) -> None:
        self.torque = torque
        self._ends = velocity_error * np.array([[-1.0], [1.0]])
        model, n = torque.model, torque.model.n_joints
        self.armature = armature_matrix(torque)
        self._momentum = Momentum(model, torque.parameters.reshape(-1, 10))
        self._rigid = TorqueModel(model, parameters=torque.parameters)
        self._rest = np.zeros(n)

    def of_sample(self, q: Array, qd: Array) -> tuple[Array, Array, Array]:
        """Return `p`, `b`, two (n,), and f (2, n) of one sample, from contiguous float64."""
        p, gradient = self._momentum(q[None], qd[None])
        ends = qd + self._ends if self._ends.any() else qd[None]
        friction = np.empty((2, q.size))
        for k, v in enumerate(ends):
            friction[k:] = self.torque(q, v, self._rest) - self._rigid(q, v, self._rest)
        return p[0] + self.armature @ qd, gradient[0] - self._rigid.gravity(q), friction

    def of_samples(self, q: Array, qd: Array) -> tuple[Array, Array, Array]:
        """Return `p`, `b`, two (N, n), and f (2, N, n) of samples (N, n)."""
        p, gradient = self._momentum(q, qd)
        ends = [qd + end for end in self._ends] if self._ends.any() else [qd]
        friction = np.empty((2, *q.shape))
        for k, v in enumerate(ends):
            friction[k:] = self.torque.friction(q, v, np.zeros(q.shape))
        return p + qd @ self.armature, gradient - self._rigid.gravity(q), friction


def friction_between(before: Array, friction: Array) -> tuple[Array, Array]:
    """Return friction between two samples, and its largest error, of the shape of a sample.

    Both samples have it at the ends of the velocities that they stand for, (2, ...). Where the
    direction of motion is unknown, or changes at an unknown time, it is anywhere between the least
    and the largest of the four.
    """
    four = np.concatenate([before, friction])
    middle = four.mean(axis=0)
    return middle, np.maximum(four.max(axis=0) - middle, middle - four.min(axis=0))


def torque_model(robot: IdentificationResult | RobotModel | TorqueModel) -> TorqueModel:
    """Return a robot as built, as described with its drives, or as it is given."""
    if isinstance(robot, IdentificationResult):
        return robot.torque_model
    return robot if isinstance(robot, TorqueModel) else TorqueModel(robot, *described_drive(robot))


def armature_matrix(torque: TorqueModel) -> Array:
    """Return the (n, n) matrix A of the part `A qdd` of the drives' torque."""
    n = torque.model.n_joints
    rest, shares = np.zeros((n, n)), torque.model.motor_shares
    at_rest, accelerated = (
        drive_torque(torque.drive, torque.values, rest, rest, qdd, load=rest, shares=shares)
        for qdd in (rest, np.eye(n))
    )
    matrix: Array = accelerated - at_rest
    return matrix
