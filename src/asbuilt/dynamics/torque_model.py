"""The torque of a robot and its drives as a function of motion, for controllers and batches."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.batches import inertial_parameters, shape_joint_samples
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.dynamics.drives.torque import drive_torque
from asbuilt.dynamics.newton_euler import OneSample, gravity_torque, inverse_dynamics, mass_matrix
from asbuilt.errors import UsageError


class TorqueModel:
    """Compute `tau = M(q) qdd + C(q, qd) qd + g(q) + drive terms`, for one sample or many.

    A call for one sample takes about the time that a compiled library takes when called from
    Python; calls for many samples are batched.

    Parameters
    ----------
    model
        The robot.
    drive
        Drive terms; none by default.
    values
        Drive parameters, shape (n_joints columns_per_joint,), joint by joint as in `drive.names`.
    parameters
        Standard inertial parameters, shape (10 n_links,); the model's own by default.

    Raises
    ------
    UsageError
        If the number of values or parameters does not fit.

    Examples
    --------
    >>> from asbuilt.description.load import load_robot
    >>> model = load_robot("two-link")
    >>> torque = TorqueModel(model, DriveSet.parse("viscous"), [0.5, 0.5])
    >>> rest, q, qd = np.zeros(2), np.zeros(2), np.array([1.0, 0.0])
    >>> (torque(q, qd, rest) - torque(q, rest, rest)).round(6).tolist()
    [0.5, 0.0]
    >>> torque.friction(q, qd, rest).tolist()
    [0.5, 0.0]
    """

    def __init__(
        self,
        model: RobotModel,
        drive: DriveSet = NO_DRIVE,
        values: ArrayLike = (),
        *,
        parameters: ArrayLike | None = None,
    ) -> None:
        self.model = model
        self.drive = drive
        self.values = np.array(values, dtype=np.float64)
        if self.values.shape != (model.n_joints * drive.columns_per_joint,):
            raise UsageError(
                f"{model.n_joints} joints with drive terms {drive} have"
                f" {model.n_joints * drive.columns_per_joint} drive parameters, got shape"
                f" {self.values.shape}"
            )
        drive.check_joints(model.n_joints)
        self.parameters = inertial_parameters(model, parameters).reshape(-1)
        self._one = OneSample(model, drive, self.values, self.parameters)

    def __call__(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return the joint torques [N m, N for prismatic joints], shape of `q`.

        `q, qd, qdd` have shape (n_joints,) or (n_samples, n_joints). Raises UsageError for shapes
        that do not fit and for values that are not finite.
        """
        torque = self._one.torque(q, qd, qdd) if type(q) is np.ndarray and q.ndim == 1 else None
        if torque is not None:
            return torque
        state = shape_joint_samples(self.model, q=q, qd=qd, qdd=qdd)
        if len(state[0]) == 1:
            torque = self._one.torque(*(array[0] for array in state))
        if torque is None:
            rigid = inverse_dynamics(self.model, *state, parameters=self.parameters)
            torque = rigid + self._evaluate_friction(state, rigid)
        return torque.reshape(np.shape(q))

    def friction(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return the torques of the drive terms alone [N m or N], shape of `q`."""
        state = shape_joint_samples(self.model, q=q, qd=qd, qdd=qdd)
        rigid = inverse_dynamics(self.model, *state, parameters=self.parameters)
        return self._evaluate_friction(state, rigid).reshape(np.shape(q))

    def gravity(self, q: ArrayLike) -> Array:
        """Return the torques `g(q)` that hold the rigid bodies at rest [N m or N], shape of `q`."""
        torque = self._one.gravity(q) if type(q) is np.ndarray and q.ndim == 1 else None
        if torque is not None:
            return torque
        return gravity_torque(self.model, q, parameters=self.parameters)

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return `M(q)` of the rigid bodies, shape of `q` and one more axis of n_joints."""
        matrix = self._one.mass_matrix(q) if type(q) is np.ndarray and q.ndim == 1 else None
        if matrix is not None:
            return matrix
        return mass_matrix(self.model, q, parameters=self.parameters)

    def armature(self) -> Array:
        """Return the (n, n) matrix A of the part `A qdd` of the drives' torque."""
        n = self.model.n_joints
        rest = np.zeros((n, n))
        shares = self.model.motor_shares
        at_rest, accelerated = (
            drive_torque(self.drive, self.values, rest, rest, qdd, load=rest, shares=shares)
            for qdd in (rest, np.eye(n))
        )
        matrix: Array = accelerated - at_rest
        return matrix

    def _evaluate_friction(self, state: tuple[Array, ...], rigid: Array) -> Array:
        shares = self.model.motor_shares
        return drive_torque(self.drive, self.values, *state, load=rigid, shares=shares)
