"""Torque of a position servo from what it was commanded and what it did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.recording import Recording

DROOP = 1.0 / 24.0
"""Outer weight of the filter `[w, 1 - 2 w, w]` whose response is that of a held sample,
`sinc(f T)`, to the fourth order in the frequency f."""


def held_command(recording: Recording, delay: float = 0.0) -> Array:
    """Return the command that acts at the times of the samples, shape (N, n).

    A command is held until the next. Below half the sampling rate that is a delay of half a period
    T and the response `sinc(f T)`; `delay` [s] comes in addition. If the recording has a servo that
    limits its goal, the goal takes the place of the command. A servo with a lead adds the rate of
    what acts, times the lead.

    Examples
    --------
    >>> t = np.arange(0.0, 1.0, 0.01)
    >>> x = t[:, None]
    >>> late = held_command(Recording(t=t, q=x, tau=x, command=x), delay=0.02)
    >>> round(float(t[50] - late[50, 0]), 6)
    0.025
    """
    return _led(recording, delay, 0)


def command_rate(recording: Recording, delay: float = 0.0) -> Array:
    """Return the time derivative of `held_command`, shape (N, n)."""
    return _led(recording, delay, 1)


def _led(recording: Recording, delay: float, derivative: int) -> Array:
    """Return a derivative of the goal and of its rate times the lead, shape (N, n)."""
    goal = _acting(recording, delay, derivative)
    if recording.servo is None or not np.any(recording.servo.leads):
        return goal
    return goal + recording.servo.leads * _acting(recording, delay, derivative + 1)


def _acting(recording: Recording, delay: float, derivative: int) -> Array:
    command, t = recording.command, recording.t
    if command is None:
        raise ValueError("the recording has no command")
    rows = np.isfinite(t) & np.all(np.isfinite(command), axis=1)
    rows[rows] = t[rows] > np.concatenate([[-np.inf], np.maximum.accumulate(t[rows])[:-1]])
    out = np.full(command.shape, np.nan)
    if np.count_nonzero(rows) < 4:
        return out
    x, t = command[rows], t[rows]
    if recording.servo is not None and recording.servo.limits_goal:
        out[rows] = _of_goal(*recording.servo.goal(t, x), t, delay, derivative)
        return out
    padded = np.concatenate([x[:1], x, x[-1:]])
    x = DROOP * (padded[:-2] + padded[2:]) + (1.0 - 2.0 * DROOP) * x
    at = t - 0.5 * float(np.median(np.diff(t))) - delay
    inside = np.clip(at, t[0], t[-1])
    values = _interpolated(t, x, inside, derivative)
    if derivative:
        values[(at < t[0]) | (at > t[-1])] = 0.0
    out[rows] = values
    return out


def _interpolated(t: Array, x: Array, at: Array, derivative: int) -> Array:
    """Return the cubic spline through x (N, n) at other times, or its derivative."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - light start

    return np.asarray(CubicSpline(t, x, axis=0)(at, derivative))


def _of_goal(fine: Array, goal: Array, t: Array, delay: float, derivative: int) -> Array:
    """Return the goal, or its derivative, below half the sampling rate, shape (K, n).

    The mean over a period T has the response `sinc(f T)` and nothing at the sampling rate; the
    filter `[-w, 1 + 2 w, -w]` undoes the response.
    """
    period = float(np.median(np.diff(t)))
    edges = np.append(fine, 2.0 * fine[-1] - fine[-2])
    means = np.diff(edges)[:, None] * goal
    sums = np.vstack([np.zeros(goal.shape[1]), np.cumsum(means, axis=0)])
    late = t - delay
    at = np.clip(late, t[0] + 0.5 * period, t[-1] - 0.5 * period)
    after, before = (
        np.stack([np.interp(at + half, edges, x) for x in sums.T], axis=1)
        for half in (0.5 * period, -0.5 * period)
    )
    values = (after - before) / period
    padded = np.concatenate([values[:1], values, values[-1:]])
    values = (1.0 + 2.0 * DROOP) * values - DROOP * (padded[:-2] + padded[2:])
    if derivative:
        values = _interpolated(t, values, t, derivative)
        values[(late < t[0]) | (late > t[-1])] = 0.0
    return np.asarray(values)


LOGGED = "tau_logged"
"""Extra quantity of a recording whose torque is that of its command: the torque that was logged."""


def driven_by_command(recording: Recording, servo: PositionServo) -> Recording:
    """Return the recording with the torque of a servo that follows its command.

    An unknown stiffness counts as 1 N m/rad, an unknown damping as 0, an unknown delay as 0: then
    the torque is a control error until the gains are identified. A torque that was logged becomes
    the extra quantity `LOGGED`.
    """
    known = replace(
        servo,
        kp=tuple(np.where(np.isfinite(servo.kp), servo.kp, 1.0)),
        kd=tuple(np.where(np.isfinite(servo.kd), servo.kd, 0.0)),
    )
    held = held_command(replace(recording, servo=servo), servo.delay or 0.0)
    tau = known.torque(held, recording.q, logged_velocity(recording))
    extra = dict(recording.extra)
    if recording.servo is None and np.any(recording.tau):
        extra[LOGGED] = recording.tau
    return replace(recording, tau=tau, torque_source="command", servo=servo, extra=extra)


def logged_velocity(recording: Recording) -> Array:
    """Return velocities by central differences of the positions as logged, shape (N, n)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.gradient(recording.q, recording.t, axis=0))
