"""Goal of a position servo that limits acceleration and speed on the way to its command."""

# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.compilation import kernel

FINEST = 1e-3
"""Longest step of the path of a goal [s]."""


def derive_goal_path(
    t: ArrayLike,
    command: ArrayLike,
    acceleration: ArrayLike,
    speed: ArrayLike = np.inf,
) -> tuple[Array, Array]:
    """Return the goal that a servo with limits derives from its command.

    Each command is a target until the next. The goal moves to it in the shortest time under
    `|g''| <= acceleration` and `|g'| <= speed`, with rest at the target, from position and velocity
    that it has when the command comes. It starts at rest at the first command.

    Parameters
    ----------
    t
        Times of the commands [s], increasing, shape (K,).
    command
        Commands [rad or m], shape (K, n).
    acceleration, speed
        Limits [rad/s^2, rad/s; m/s^2, m/s], shape (n,); infinite where there is none.

    Returns
    -------
    tuple of two Arrays
        Times [s] at which steps of at most `FINEST` begin, shape (M,), and the goal in the middle
        of each step, shape (M, n). The last command is held.

    Examples
    --------
    A step of 1 rad at 4 rad/s^2 takes 1 s, half of it to speed up.

    >>> t, goal = derive_goal_path([0.0, 0.001, 2.0], [[0.0], [1.0], [1.0]], 4.0)
    >>> [round(float(np.interp(at, t, goal[:, 0])), 2) for at in (0.501, 1.001, 1.5)]
    [0.5, 1.0, 1.0]
    """
    t = np.asarray(t, dtype=np.float64)
    command = np.asarray(command, dtype=np.float64)
    n = command.shape[1]
    period = float(np.median(np.diff(t))) if len(t) > 1 else FINEST
    parts = max(1, math.ceil(period / FINEST - 1e-9))
    ends = np.append(t, t[-1] + period)
    fine = (ends[:-1, None] + np.diff(ends)[:, None] * np.arange(parts) / parts).ravel()
    out = np.repeat(command, parts, axis=0)
    for k in range(n):
        a = float(np.broadcast_to(acceleration, n)[k])
        v = float(np.broadcast_to(speed, n)[k])
        if np.isfinite(a):
            own = np.empty(len(fine))
            _follow(ends, np.ascontiguousarray(command[:, k]), a, v, parts, own)
            out[:, k] = own
    return fine, out


@kernel("f1 f1 f f i F1")
def _follow(ends, command, a, fastest, parts, out):
    """Write the goal in the middle of each part of every period."""
    goal = command[0]
    rate = 0.0
    for k in range(command.size):
        period = ends[k + 1] - ends[k]
        way = command[k] - goal
        side = 1.0 if way > rate * abs(rate) / (2.0 * a) else -1.0
        y = side * way
        w = side * rate
        # speed up from w to the peak, hold it, slow down to rest at y
        peak = np.sqrt(max(a * y + 0.5 * w * w, 0.0))
        held = 0.0
        if peak > fastest:
            peak = fastest
            held = max((y - (peak * peak - 0.5 * w * w) / a) / peak, 0.0)
        up = max((peak - w) / a, 0.0)
        down = peak / a
        first = w * up + 0.5 * a * up * up
        second = first + peak * held
        for j in range(parts + 1):
            at = period if j == parts else (j + 0.5) * period / parts
            if at < up:
                p = w * at + 0.5 * a * at * at
                v = w + a * at
            elif at < up + held:
                p = first + peak * (at - up)
                v = peak
            elif at < up + held + down:
                left = at - up - held
                p = second + peak * left - 0.5 * a * left * left
                v = peak - a * left
            else:
                p = y
                v = 0.0
            if j < parts:
                out[k * parts + j] = goal + side * p
            else:
                goal = goal + side * p
                rate = side * v
