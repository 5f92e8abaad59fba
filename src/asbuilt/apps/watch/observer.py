"""Generalised momentum observer of external torque."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.apps.watch.causal_filter import CausalFilter, choose_pole, filter_log, filter_pole
from asbuilt.apps.watch.observed import ModelError, Observed
from asbuilt.apps.watch.thresholds import Thresholds
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.dynamics import Momentum, TorqueModel, apply_lag, described_drive
from asbuilt.errors import RecordingError, UsageError
from asbuilt.findings import Cure
from asbuilt.identification import IdentificationResult

BANDWIDTH = 8.0
"""Bandwidth [Hz]: 63 % of a step within 20 ms."""
LONGEST_STEP = 0.1
"""Time between samples [s] from which the observer starts again."""


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
        model = torque.model
        n = torque.model.n_joints
        self.armature = torque.armature()
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


def bracket_friction(before: Array, friction: Array) -> tuple[Array, Array]:
    """Return friction between two samples, and its largest error, of the shape of a sample.

    Both samples have it at the ends of the velocities that they stand for, (2, ...). Where the
    direction of motion is unknown, or changes at an unknown time, it is anywhere between the least
    and the largest of the four.
    """
    four = np.concatenate([before, friction])
    # As `mean`, `max` and `min` of axis 0, in half of their time for one sample.
    middle = np.add.reduce(four) / len(four)
    least = np.minimum.reduce(four)
    largest = np.maximum.reduce(four)
    return middle, np.maximum(largest - middle, middle - least)


def build_torque_model(robot: IdentificationResult | RobotModel | TorqueModel) -> TorqueModel:
    """Return a robot as built, as described with its drives, or as it is given."""
    if isinstance(robot, IdentificationResult):
        return robot.torque_model
    return robot if isinstance(robot, TorqueModel) else TorqueModel(robot, *described_drive(robot))


class Observer:
    """Estimate the external torque from momentum, sample by sample.

    The residual is `r = K (p - p(0) - integral(tau + b + r) dt)` with `p = (M + A) qd` and
    `b = C^T qd - g - friction`, so that `dr/dt = K (tau_ext - r)`: each joint's external torque
    behind a first-order lag, without accelerations and without inverting M. Between samples the
    external torque is taken as constant and `tau + b` as linear; then

    `r_k = a r_(k-1) + (1 - a) ((p_k - p_(k-1)) / dt - (tau + b)_mean)`, `a = exp(-K dt)`,

    is exact for any step, hence stable for any clock. Sources: De Luca and Mattone (2005),
    Haddadin, De Luca and Albu-Schaeffer (2017), section IV-C.

    Parameters
    ----------
    robot
        An identified robot, or one as described with the drives of its description.
    bandwidth
        K over 2 pi [Hz].
    velocity_error
        Largest error (n,) of the velocities [rad/s or m/s], 0 by default (`largest_velocity_error`
        finds it). Within it of standstill the direction of friction is unknown; friction then is
        the mean of both, and half of their difference adds to the threshold.
    thresholds
        Limits of the residual, for `threshold` and `alarms`; their bandwidth and velocity error
        replace those given.

    Raises
    ------
    UsageError
        If the bandwidth is not positive, a velocity error is negative or not one per joint, or
        thresholds belong to other joints.

    Examples
    --------
    A constant torque of 1 N m on the first joint of an arm held still:

    >>> import asbuilt
    >>> model = asbuilt.load_robot("two-link")
    >>> observer, q = Observer(model, bandwidth=8.0), np.array([0.3, 0.4])
    >>> held = asbuilt.gravity_torque(model, q) - [1.0, 0.0]
    >>> for k in range(101):
    ...     residual = observer.update(0.001 * k, q, held, np.zeros(2))
    >>> (residual[0] - (1.0 - np.exp(-2 * np.pi * 8.0 * 0.1))).round(9).item()
    0.0
    """

    def __init__(
        self,
        robot: IdentificationResult | RobotModel | TorqueModel,
        *,
        bandwidth: float = BANDWIDTH,
        velocity_error: ArrayLike = 0.0,
        thresholds: Thresholds | None = None,
    ) -> None:
        self.torque_model = build_torque_model(robot)
        self.model = self.torque_model.model
        if thresholds is not None:
            thresholds.check_joints(self.model.joint_names)
            bandwidth = thresholds.bandwidth
            velocity_error = thresholds.velocity_error
        if not (np.isfinite(bandwidth) and bandwidth > 0.0):
            raise UsageError(f"the bandwidth must be a positive number [Hz], got {bandwidth}")
        self.bandwidth = bandwidth
        self.thresholds = thresholds
        self.velocity_error = _expand_velocity_error(velocity_error, self.model.n_joints)
        self.model_error = ModelError.of(robot)
        self._balance = MomentumBalance(self.torque_model, self.velocity_error)
        self._gain = 2.0 * np.pi * bandwidth
        self._filter: CausalFilter | None = None
        self.restart()

    def restart(self) -> None:
        """Forget everything but the robot."""
        n = self.model.n_joints
        self._t: float | None = None
        self._p = self._s = self._tau = np.zeros(n)
        self._friction = np.zeros((2, n))
        self.q, self.qd, self.qdd, self.residual = np.zeros((4, n))
        self.slowness, self.step, self.unknown_friction = np.zeros((3, n))

    def update(self, t: float, q: ArrayLike, tau: ArrayLike, qd: ArrayLike | None = None) -> Array:
        """Return the residual (n,) [N m or N] after one more sample.

        Parameters
        ----------
        t
            Time [s]. After more than 0.1 s without a sample the observer starts again.
        q, tau
            Positions [rad or m] and torques [N m or N] of the drives, shape (n,).
        qd
            Velocities, shape (n,); None: positions and torques go through one causal filter, which
            differentiates, and delays both by half of the observer's lag.

        Raises
        ------
        UsageError
            If time does not advance, shapes do not fit or a value is not finite.
        """
        n = self.model.n_joints
        last = self._t
        given = [np.array(x, dtype=np.float64) for x in (q, tau) + (() if qd is None else (qd,))]
        for name, value in zip(("q", "tau", "qd"), given, strict=False):
            if value.shape != (n,) or not np.isfinite(value).all():
                raise UsageError(f"{name} must be {n} finite numbers at t = {t:g} s, got {value}")
        if last is not None and not t > last:
            raise UsageError(f"time must advance, got {t:g} s after {last:g} s")
        dt = np.inf if last is None else t - last
        if dt > LONGEST_STEP:
            self.restart()
            self._filter = None
        q, v, tau = self._pass_filter(dt, *given) if qd is None else (given[0], given[2], given[1])
        self._t = t
        if self._filter is not None and not self._filter.is_settled:
            dt = np.inf
        self._advance(dt, q, v, tau)
        return self.residual.copy()

    @property
    def limits(self) -> Thresholds:
        """The thresholds; raises `UsageError` without any."""
        if self.thresholds is None:
            raise UsageError(
                "this observer has no thresholds",
                cure=Cure("give it thresholds", call="set_thresholds"),
            )
        return self.thresholds

    @property
    def least_threshold(self) -> Array:
        """The threshold (n,) of a model without errors, which takes less time."""
        return self._evaluate_threshold(np.zeros(self.residual.shape))

    @property
    def threshold(self) -> Array:
        """The residual (n,) beyond which the last sample is an alarm."""
        error = self.model_error.std(self.q[None], self.qd[None], self.qdd[None])[0]
        return self._evaluate_threshold(error)

    def _evaluate_threshold(self, error: Array) -> Array:
        parts = self.slowness, self.step, self.unknown_friction
        return self.limits.limit(self.qd, *parts, error)

    @property
    def alarms(self) -> tuple[str, ...]:
        """Names of the joints whose residual is beyond its threshold."""
        beyond = np.abs(self.residual) > self.threshold
        return tuple(name for name, off in zip(self.model.joint_names, beyond, strict=True) if off)

    def observe(
        self, t: ArrayLike, q: ArrayLike, tau: ArrayLike, qd: ArrayLike | None = None
    ) -> Observed:
        """Return what `update` gives on a whole log, at once; the observer itself is unchanged.

        Parameters
        ----------
        t
            Times [s], shape (N,).
        q, tau, qd
            As for `update`, shape (N, n).

        Raises
        ------
        RecordingError
            If time does not advance, or a value is not finite.
        """
        times = np.asarray(t, dtype=np.float64)
        q, tau = (np.ascontiguousarray(x, dtype=np.float64) for x in (q, tau))
        steps = np.diff(times, prepend=-np.inf)
        if not np.all(steps > 0.0):
            k = int(np.argmin(steps > 0.0))
            raise RecordingError(
                f"time must advance, got {times[k]:g} s after {times[k - 1]:g} s",
                cure=Cure("sort the samples by time, and leave repeated ones out"),
                time=float(times[k]),
            )
        steps[steps > LONGEST_STEP] = -1.0
        if qd is None:
            q, v, tau, settled = filter_log(steps, q, tau, choose_pole(steps, self.bandwidth))
            steps[~settled] = -1.0
        else:
            v = np.ascontiguousarray(qd, dtype=np.float64)
        _check_finite(times, q=q, tau=tau, qd=v)
        share = np.where(steps > 0.0, -np.expm1(-self._gain * np.maximum(steps, 0.0)), -1.0)
        p, b, friction = self._balance.of_samples(q, v)
        s = tau + b
        inner = np.maximum(steps, 1e-12)[1:, None]
        rate, step, unknown, external = np.zeros((4, *q.shape))
        middle, unknown[1:] = bracket_friction(friction[:, :-1], friction[:, 1:])
        external[1:] = np.diff(p, axis=0) / inner - 0.5 * (s[1:] + s[:-1]) + middle
        rate[1:] = np.diff(v, axis=0) / inner
        step[1:] = np.abs(np.diff(tau, axis=0))
        parts = (apply_lag(share, x) for x in (rate, step, unknown, external))
        return Observed(times, share, q, v, *parts)

    def _pass_filter(self, dt: float, q: Array, tau: Array) -> tuple[Array, Array, Array]:
        """Return filtered position, velocity and torque; the second sample settles the filter."""
        both = np.concatenate([q, tau])
        n = q.size
        if not np.isfinite(dt) or self._filter is None:
            self._filter = CausalFilter(filter_pole(self.bandwidth, 1e3))
            self._filter.start(both)
            return q, np.zeros(n), tau
        if self._filter.age == 0.0:
            # Without thresholds the first step shows the rate; it may be an odd one.
            rate = 1.0 / dt if self.thresholds is None else self.thresholds.rate
            self._filter.pole = filter_pole(self.bandwidth, rate)
        x, v = self._filter.update(dt, both)
        return x[:n].copy(), v[:n].copy(), x[n:].copy()

    def _advance(self, dt: float, q: Array, qd: Array, tau: Array) -> None:
        p, b, f = self._balance.of_sample(np.ascontiguousarray(q), np.ascontiguousarray(qd))
        s = tau + b
        if dt <= LONGEST_STEP:
            share = -np.expm1(-self._gain * dt)
            middle, unknown = bracket_friction(self._friction, f)
            external = (p - self._p) / dt - 0.5 * (s + self._s) + middle
            self.residual = self.residual + share * (external - self.residual)
            self.qdd = self.qdd + share * ((qd - self.qd) / dt - self.qdd)
            self.step = self.step + share * (np.abs(tau - self._tau) - self.step)
            self.unknown_friction = self.unknown_friction + share * (
                unknown - self.unknown_friction
            )
            if self.thresholds is not None:
                slow = self.thresholds.slow(self.qd, qd)
                self.slowness = self.slowness + share * (slow - self.slowness)
        self._p = p
        self._s = s
        self._friction = f
        self._tau = tau
        self.q = q
        self.qd = qd


def _expand_velocity_error(velocity_error: ArrayLike, n: int) -> Array:
    """Return velocity errors as (n,), or raise `UsageError`."""
    given = np.asarray(velocity_error, dtype=np.float64)
    if given.shape not in ((), (n,)) or not np.all(np.isfinite(given) & (given >= 0.0)):
        raise UsageError(f"velocity errors must be {n} numbers, at least 0, got {given.tolist()}")
    return np.broadcast_to(given, n)


def _check_finite(t: Array, **given: Array) -> None:
    for name, values in given.items():
        if not np.isfinite(values).all():
            sample, joint = np.argwhere(~np.isfinite(values))[0]
            raise RecordingError(
                f"{name} of joint {joint + 1} is {values[sample, joint]} at t = {t[sample]:g} s",
                cure=Cure("remove or fill such samples first"),
                time=float(t[sample]),
            )
