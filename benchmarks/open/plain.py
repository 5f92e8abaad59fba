"""The plain processing that every bare regressor gets: a zero-phase low-pass and differences.

Positions go through a Butterworth low-pass of order 4 forwards and backwards on a uniform grid,
velocities and accelerations are central differences of them, torques go through the same low-pass.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.signal import butter, filtfilt

Array = Any
ORDER = 4
EDGE = 1.0
"""Seconds at both ends of a log that the filter disturbs; neither fitted nor scored."""


class Motion(NamedTuple):
    """Filtered states on a uniform grid `t` (N,), each (N, n); `tau` is None where it is hidden."""

    t: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array | None = None

    def inner(self, edge: float = EDGE) -> slice:
        """Return the rows away from both ends."""
        inside = np.flatnonzero((self.t >= self.t[0] + edge) & (self.t <= self.t[-1] - edge))
        return slice(int(inside[0]), int(inside[-1]) + 1)


def uniform(t: Array, x: Array, grid: Array) -> Array:
    """Return columns at other times, linear between samples."""
    return np.column_stack([np.interp(grid, t, column) for column in x.T])


def low_pass(x: Array, rate: float, cutoff: float) -> Array:
    """Return columns (N, n) without what is above a cutoff [Hz] (-3 dB after both passes)."""
    once = cutoff / (2.0**0.5 - 1.0) ** (0.5 / ORDER)
    if once >= 0.45 * rate:
        return np.array(x)
    b, a = butter(ORDER, once / (rate / 2.0))
    return filtfilt(b, a, x, axis=0, padlen=min(len(x) - 1, 3 * ORDER * 5))


def plain_motion(t: Array, q: Array, tau: Array | None, rate: float, cutoff: float) -> Motion:
    """Return filtered states, and the filtered torque unless it is hidden."""
    grid = np.arange(t[0], t[-1], 1.0 / rate)
    position = low_pass(uniform(t, q, grid), rate, cutoff)
    qd = np.gradient(position, grid, axis=0)
    qdd = np.gradient(qd, grid, axis=0)
    torque = None if tau is None else low_pass(uniform(t, tau, grid), rate, cutoff)
    return Motion(grid, position, qd, qdd, torque)
