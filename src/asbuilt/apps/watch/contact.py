"""Force and point of a contact from the external torque of the joints; the smallest found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from asbuilt.apps.watch.causal_filter import choose_pole
from asbuilt.apps.watch.observed import Observed
from asbuilt.apps.watch.observer import Observer
from asbuilt.apps.watch.thresholds import HALF
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.dynamics import link_jacobians, link_poses

STEP = 1e-6


WITHIN = 0.020
"""Time [s] in which a collision is to be found."""
POSES = 40
LEAST_TORQUE = 1e-9
"""Torque per newton below which a joint does not feel a force."""


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
    force, error, misfit = _fit_columns(jacobian[3:].T, residual, covariance)
    freedom = max(len(residual) - int(np.linalg.matrix_rank(jacobian[3:])), 0)
    p_value = float(chdtrc(freedom, misfit)) if freedom else float("nan")
    errors = np.sqrt(np.diag(error))
    if np.linalg.matrix_rank(jacobian) < 6:
        return Contact(force, errors, p_value)
    wrench, error, _ = _fit_columns(jacobian.T, residual, covariance)
    size = float(np.linalg.norm(wrench[3:]))
    along = wrench[3:] / size if size > 0.0 else np.zeros(3)
    # 3.0: force, in standard errors, from which a point is given.
    if size < 3.0 * np.sqrt(along @ error[3:, 3:] @ along):
        return Contact(force, errors, p_value)
    point = _find_nearest_point(wrench)
    slopes = np.column_stack(
        [
            (_find_nearest_point(wrench + STEP * size * unit) - point) / (STEP * size)
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


def _fit_columns(columns: Array, values: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Return estimate, its covariance and the weighted sum of squares left."""
    root = np.linalg.cholesky(covariance)
    A = np.linalg.solve(root, columns)
    b = np.linalg.solve(root, values)
    # Standard deviation [N, N m] of the prior of forces and moments: what torques leave open keeps
    # an error of this size.
    error: Array = np.asarray(np.linalg.inv(A.T @ A + np.eye(A.shape[1]) / 1e3**2), np.float64)
    found: Array = error @ A.T @ b
    return found, error, float(np.sum((b - A @ found) ** 2))


def _find_nearest_point(wrench: Array) -> Array:
    """Return the point p of `m = p x f` that is nearest to the origin, `f x m / f^2`."""
    moment = wrench[:3]
    force = wrench[3:]
    return np.asarray(np.cross(force, moment) / (force @ force))


def find_smallest_forces(
    observer: Observer,
    observed: Observed,
    limit: Array,
    tool: tuple[int, Array],
    *,
    filtered: bool,
) -> Array:
    """Return the smallest steps of force [N] at the tool that alarm in time, in some poses (m,).

    The residual is linear in the external torque, so a step of force adds its lagged share to the
    residual found without it, and a smaller share, as a step of torque, to the threshold.
    Directions are random, times are equally spaced.

    Parameters
    ----------
    observer, observed, limit
        The observer, what it made of a log, and thresholds (N, n).
    tool
        Link that carries the tool, counted from 0, and pose (4, 4) of the tool's frame in it.
    filtered
        Whether positions and torques went through the causal filter.
    """
    rng = np.random.default_rng(0)
    steps = np.diff(observed.t)
    pole = choose_pole(steps, observer.bandwidth) if filtered else None
    share = excess_response(observer, WITHIN, float(np.median(steps)), pole)
    found = []
    for k in np.unique(np.linspace(0.1, 0.9, POSES) * (len(observed.t) - 1)).astype(int):
        along = rng.normal(size=3)
        along /= np.linalg.norm(along)
        torque = frame_jacobian(observer.model, observed.q[k], *tool)[3:].T @ along
        left = limit[k] - np.sign(torque) * observed.residual[k]
        felt = np.abs(torque) > LEAST_TORQUE
        if felt.any():
            found.append(max(float(np.min(left[felt] / np.abs(torque[felt]))) / share, 0.0))
    return np.array(found)


def excess_response(observer: Observer, time: float, spacing: float, pole: float | None) -> float:
    """Return what a step of external torque adds to the residual, less to the threshold, in `time`.

    The lagged size of the steps of torque between samples of a `spacing` [s] is the change of the
    step response within one of them.
    """
    now, before = (step_response(observer, max(at, 0.0), pole) for at in (time, time - spacing))
    return now - HALF * (now - before)


def step_response(observer: Observer, time: float, pole: float | None) -> float:
    """Return the share of a step of external torque in the residual after `time` [s].

    `1 - exp(-K t)` of the observer; behind the causal filter with its double pole w [rad/s] the
    inverse Laplace transform of `K w^2 / (s (s + K) (s + w)^2)`.

    >>> import asbuilt
    >>> observer = Observer(asbuilt.load_robot("two-link"), bandwidth=8.0)
    >>> round(step_response(observer, 0.02, None), 3), round(step_response(observer, 0.02, 200), 3)
    (0.634, 0.386)
    """
    gain = 2.0 * np.pi * observer.bandwidth
    if pole is None:
        return float(-np.expm1(-gain * time))
    w = pole if abs(pole / gain - 1.0) > 1e-3 else 1.001 * gain
    slow = (w / (w - gain)) ** 2
    double = gain * w / (w - gain)
    faded = (slow - 1.0 + double * time) * np.exp(-w * time)
    return float(1.0 - slow * np.exp(-gain * time) + faded)
