"""What enters the balance of momentum of a robot besides the torques of the drives."""

# mypy: allow-untyped-calls

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.torque import described_drive, drive_torque
from asbuilt.dynamics.kernels import momentum as kernels
from asbuilt.dynamics.momentum import mechanism_of
from asbuilt.dynamics.torque_model import TorqueModel
from asbuilt.identification.result.result import IdentificationResult


class MomentumBalance:
    """Evaluate `p` and `b` of `dp/dt = tau + b + tau_ext`.

    `p = (M(q) + A) qd` with the constant armature A of the drives, rotors that several joints turn
    included, and `b = C(q, qd)^T qd - g(q) - f(q, qd)`. Friction f takes its load at `qdd = 0`.

    Parameters
    ----------
    torque
        The robot with its drives.
    """

    def __init__(self, torque: TorqueModel) -> None:
        self.torque = torque
        model, n = torque.model, torque.model.n_joints
        self.armature = armature_matrix(torque)
        self._chi = np.ascontiguousarray(torque.parameters.reshape(n, 10))
        self._mechanism = mechanism_of(model)
        self._rigid = TorqueModel(model, parameters=torque.parameters)
        self._rest = np.zeros(n)
        self._out = np.empty((2, 1, n))

    def of_sample(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return `p` and `b` of one sample, two (n,), from contiguous arrays of float64."""
        p, gradient = self._out
        kernels.momentum(*self._mechanism, self._chi, q[None], qd[None], p, gradient)
        friction = self.torque(q, qd, self._rest) - self._rigid(q, qd, self._rest)
        return p[0] + self.armature @ qd, gradient[0] - self._rigid.gravity(q) - friction

    def of_samples(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return `p` and `b` of samples (N, n), two (N, n)."""
        p, gradient = np.empty(q.shape), np.empty(q.shape)
        kernels.momentum(*self._mechanism, self._chi, q, qd, p, gradient)
        friction = self.torque.friction(q, qd, np.zeros(q.shape))
        return p + qd @ self.armature, gradient - self._rigid.gravity(q) - friction


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
