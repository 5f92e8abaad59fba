"""Force and point of a contact from the external torque of the joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kinematics import link_jacobians, link_poses

STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Hold a force at a frame and, where the torques determine it, its line of action.

    Parameters
    ----------
    force, force_error
        Force on the robot at the origin of the frame, in root axes [N], (3,), and standard errors.
    p_value
        Probability of a worse fit to the torques if a force acts there and there alone.
    point, point_error
        Point of the line of action nearest to the origin of the frame, from there, in root axes
        [m], (3,), for a force at any place of the link; None with fewer than six joints or an
        unclear force.
    """

    force: Array
    force_error: Array
    p_value: float
    point: Array | None = None
    point_error: Array | None = None


def estimate_contact(
    model: RobotModel, q: Array, residual: Array, covariance: Array, link: int, placement: Array
) -> Contact:
    """Return the force that explains external torques as a contact at a frame.

    Weighted least squares of `tau_ext = J^T [m; f]`, with a moment of `m = 0` for a force at the
    origin, and free for the line of action (Haddadin et al. 2017, section V).

    Parameters
    ----------
    model
        The robot.
    q, residual, covariance
        Positions and external torques of one sample (n,), and their covariance (n, n).
    link, placement
        Link that carries the frame, counted from 0, and pose (4, 4) of the frame in it.
    """
    jacobian = frame_jacobian(model, q, link, placement)
    force, error, misfit = _fitted(jacobian[3:].T, residual, covariance)
    freedom = max(len(residual) - int(np.linalg.matrix_rank(jacobian[3:])), 0)
    p_value = float(chdtrc(freedom, misfit)) if freedom else float("nan")
    errors = np.sqrt(np.diag(error))
    if np.linalg.matrix_rank(jacobian) < 6:
        return Contact(force, errors, p_value)
    wrench, error, _ = _fitted(jacobian.T, residual, covariance)
    size = float(np.linalg.norm(wrench[3:]))
    along = wrench[3:] / size if size > 0.0 else np.zeros(3)
    # 3.0: force, in standard errors, from which a point is given.
    if size < 3.0 * np.sqrt(along @ error[3:, 3:] @ along):
        return Contact(force, errors, p_value)
    point = _nearest_point(wrench)
    slopes = np.column_stack(
        [
            (_nearest_point(wrench + STEP * size * unit) - point) / (STEP * size)
            for unit in np.eye(6)
        ]
    )
    return Contact(force, errors, p_value, point, np.sqrt(np.diag(slopes @ error @ slopes.T)))


def frame_jacobian(model: RobotModel, q: Array, link: int, placement: Array) -> Array:
    """Return angular, then linear velocity of a frame per joint rate, in root axes, (6, n)."""
    turned = link_poses(model, q)[link][:3, :3]
    angular, linear = np.split(link_jacobians(model, q)[link], 2)
    moved = linear + np.cross(angular.T, placement[:3, 3]).T
    return np.vstack([turned @ angular, turned @ moved])


def _fitted(columns: Array, values: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Return estimate, its covariance and the weighted sum of squares left."""
    root = np.linalg.cholesky(covariance)
    A, b = np.linalg.solve(root, columns), np.linalg.solve(root, values)
    # Standard deviation [N, N m] of the prior of forces and moments: what torques leave open keeps
    # an error of this size.
    error: Array = np.asarray(np.linalg.inv(A.T @ A + np.eye(A.shape[1]) / 1e3**2), np.float64)
    found: Array = error @ A.T @ b
    return found, error, float(np.sum((b - A @ found) ** 2))


def _nearest_point(wrench: Array) -> Array:
    """Return the point p of `m = p x f` that is nearest to the origin, `f x m / f^2`."""
    moment, force = wrench[:3], wrench[3:]
    return np.asarray(np.cross(force, moment) / (force @ force))
