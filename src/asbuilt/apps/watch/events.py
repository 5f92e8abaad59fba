"""Events of a log: contact with its force and point, fault of a joint, change of payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc

from asbuilt.apps.watch.causal_filter import choose_pole
from asbuilt.apps.watch.observed import Observed
from asbuilt.apps.watch.observer import Observer
from asbuilt.apps.watch.thresholds import HALF, Thresholds
from asbuilt.arrays import Array, Indices
from asbuilt.codec import make_plain
from asbuilt.description import RobotModel
from asbuilt.dynamics import link_jacobians, link_poses, observation_matrix

Kind = Literal["contact", "fault", "payload"]


# Hold when an event counts as a fault or a payload.

# Duration [s] from which an offset of one joint counts as a fault, and a payload is considered
EVENT_PERSISTENT = 2.0
# Share of an event in which a joint must be beyond its threshold to take part in an offset
EVENT_MOSTLY = 0.5
# Share of its threshold that the residual of a joint without a part in an event may reach
EVENT_QUIET = 0.7
EVENT_EXPLAINED = 0.8  # Share of the residual's squares that a payload must explain
# Largest condition number (columns scaled) of the four parameters of a payload
EVENT_DETERMINED = 200.0
EVENT_CLEAR = 3.0  # Least mass of a payload, in standard errors
EVENT_MOST_ROWS = 400  # Samples that a payload is fitted to
EVENT_CLUSTER = 1.0  # Time [s] in which errors of the model count as one


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """Hold one time in which a residual is beyond its threshold.

    Parameters
    ----------
    kind
        `"contact"`; `"fault"`: a lasting offset of one joint alone, as of a sensor, a gain or a
        brake; `"payload"`: a lasting change that a change of mass on the flange explains.
    start, end, peak
        Times [s] of the first and last sample beyond a threshold, and of the largest excess.
    joints
        Joints beyond their thresholds at any time, in the order of the chain.
    link
        Link at or beyond which a contact acts: the link of the last joint that responds.
    residual, threshold
        External torque and threshold at the peak, (n,) [N m or N].
    contact
        The force at the tool that explains the peak.
    mass, mass_error
        Change of mass [kg] and its standard error, of a payload.
    """

    kind: Kind
    start: float
    end: float
    peak: float
    joints: tuple[str, ...]
    link: str
    residual: Array
    threshold: Array
    contact: Contact
    mass: float | None = None
    mass_error: float | None = None

    @property
    def duration(self) -> float:
        """Time from the first to the last sample beyond a threshold [s]."""
        return self.end - self.start

    @property
    def excess(self) -> float:
        """Largest residual at the peak, per threshold."""
        return float(np.max(np.abs(self.residual) / self.threshold))

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists."""
        return dict(make_plain(self))


def find_events(
    observer: Observer,
    observed: Observed,
    scale: Array,
    limit: Array,
    tool: tuple[int, Array],
) -> tuple[Event, ...]:
    """Return the events of a log in order of time.

    A block without a residual beyond its threshold ends an event.

    Parameters
    ----------
    observer, observed
        The observer, with thresholds, and what it made of the log.
    scale, limit
        Scale and threshold of the residual (N, n), of `Thresholds.of_log`.
    tool
        Link that carries the tool, counted from 0, and pose (4, 4) of the tool's frame in it.
    """
    beyond = np.abs(observed.residual) > limit
    places = np.flatnonzero(beyond.any(axis=1))
    if places.size == 0:
        return ()
    cuts = np.flatnonzero(np.diff(observed.t[places]) > observer.limits.block_seconds) + 1
    return tuple(
        _make_event(observer, observed, scale, limit, slice(part[0], part[-1] + 1), tool)
        for part in np.split(places, cuts)
    )


def join_events(events: Sequence[Event], thresholds: Thresholds) -> tuple[Event, ...]:
    """Return events with those closer than a block joined, as chunks of a log divide them."""
    found: list[Event] = []
    for event in events:
        if found and event.start - found[-1].end <= thresholds.block_seconds:
            before = found.pop()
            larger = max(before, event, key=lambda one: one.excess)
            responding = {*before.joints, *event.joints}
            names = tuple(name for name in thresholds.joint_names if name in responding)
            found.append(replace(larger, start=before.start, end=event.end, joints=names))
        else:
            found.append(event)
    return tuple(found)


def _make_event(
    observer: Observer,
    observed: Observed,
    scale: Array,
    limit: Array,
    part: slice,
    tool: tuple[int, Array],
) -> Event:
    model = observer.model
    t = observed.t[part]
    ratio = np.abs(observed.residual[part]) / limit[part]
    peak = part.start + int(np.argmax(ratio.max(axis=1)))
    responding = np.flatnonzero((ratio > 1.0).any(axis=0))
    here = slice(peak, peak + 1)
    q = observed.q[peak]
    r = observed.residual[peak]
    error = observer.limits.covariance(observed.part(here), scale[here], observer.model_error)
    event = Event(
        kind="contact",
        start=float(t[0]),
        end=float(t[-1]),
        peak=float(observed.t[peak]),
        joints=tuple(model.joint_names[k] for k in responding),
        link=model.link_names[_find_last_joint(model, responding, ratio)],
        residual=r,
        threshold=limit[peak],
        contact=estimate_contact(model, q, r, error, *tool),
    )
    if event.duration < EVENT_PERSISTENT:
        return event
    mass = estimate_payload_change(observer, observed.part(part), scale[part], tool[0])
    if mass is not None:
        return replace(event, kind="payload", mass=mass[0], mass_error=mass[1])
    lasting = np.mean(ratio > 1.0, axis=0) > EVENT_MOSTLY
    if lasting.sum() == 1 and np.all(np.quantile(ratio, 0.9, axis=0)[~lasting] < EVENT_QUIET):
        return replace(event, kind="fault")
    return event


def _find_last_joint(model: RobotModel, responding: Indices, ratio: Array) -> int:
    """Return the responding joint farthest from the root; of branches that responding most."""
    routes = {k: model.ancestors(k) for k in responding.tolist()}
    carriers = {k for route in routes.values() for k in route[:-1]}
    ends = sorted(routes.keys() - carriers)
    return int(max(ends, key=lambda k: (float(ratio[:, k].max()), len(routes[k]))))


def estimate_payload_change(
    observer: Observer, observed: Observed, scale: Array, link: int
) -> tuple[float, float] | None:
    """Return the change of mass [kg] at a link that explains the residual, and its error, or None.

    `scale` (N, n) are standard deviations of the residual. Errors of the model last as long as a
    pose does, so the standard error is computed over clusters of `EVENT_CLUSTER` seconds (Liang
    and Zeger, 1986).
    """
    t = observed.t
    memory = 5.0 / (2.0 * np.pi * observer.bandwidth) / float(np.median(np.diff(t)))
    rows = np.arange(0, len(t), max(1, round(max(memory, len(t) / EVENT_MOST_ROWS))))
    weight = 1.0 / np.maximum(scale[rows], 1e-9).ravel()
    columns = 10 * link + np.arange(6, 10)
    state = (observed.q[rows], observed.qd[rows], observed.qdd[rows])
    A = weight[:, None] * observation_matrix(observer.model, *state, columns=columns)
    b = -weight * observed.residual[rows].ravel()
    lengths = np.linalg.norm(A, axis=0)
    if len(b) <= 8 or np.any(lengths == 0.0) or np.linalg.cond(A / lengths) > EVENT_DETERMINED:
        return None
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    left = b - A @ found
    times = np.repeat(t[rows], observed.q.shape[1])
    error = _estimate_clustered_error(A, left, np.floor((times - t[0]) / EVENT_CLUSTER))
    explained = float(np.sum(left**2)) <= (1.0 - EVENT_EXPLAINED) * float(b @ b)
    return (float(found[3]), error) if explained and abs(found[3]) >= EVENT_CLEAR * error else None


def _estimate_clustered_error(A: Array, left: Array, cluster: Array) -> float:
    """Return the standard error of the last of p parameters, from sums over clusters of rows."""
    names, place = np.unique(cluster, return_inverse=True)
    scores = np.zeros((len(names), A.shape[1]))
    np.add.at(scores, place, A * left[:, None])
    spread = np.linalg.solve(A.T @ A, scores.T)[-1]
    return float(np.sqrt(np.sum(spread**2) * len(names) / max(len(names) - A.shape[1], 1)))


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
