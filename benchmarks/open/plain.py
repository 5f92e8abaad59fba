"""The plain processing that every bare regressor gets: a zero-phase low-pass and differences.

Positions go through a Butterworth low-pass of order 4 forwards and backwards on a uniform grid,
velocities and accelerations are central differences of them, torques go through the same low-pass.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.signal import butter, filtfilt

Array = Any
ORDER = 4
EDGE = 1.0
"""Seconds at both ends of a log that the filter disturbs; neither fitted nor scored. Logs of a few
seconds have a shorter edge, which their task states."""


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


def ending_low_pass(x: Array, rate: float, cutoff: float) -> Array:
    """Return columns (N, n) after a Gaussian kernel, -3 dB at a cutoff [Hz], of finite width.

    What a foot that touches down does is spread to `closed_contacts` and no further; `low_pass`
    rings on.
    """
    sigma = np.sqrt(np.log(2.0)) * rate / (2.0 * np.pi * cutoff)
    return gaussian_filter1d(np.asarray(x), sigma, axis=0, radius=int(0.5 * rate / cutoff))


def logged_motion(log: dict[str, Array], rate: float, cutoff: float) -> Motion:
    """Return logged states of a free base and torques after the low-pass, quaternions of length 1.

    Rates of a base are no derivatives of its pose, so those of the log are taken.
    """
    q, qd, qdd, tau = (ending_low_pass(log[key], rate, cutoff) for key in ("q", "qd", "qdd", "tau"))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1)[:, None]
    return Motion(log["t"], q, qd, qdd, tau)


def closed_contacts(contact: Array, rate: float, cutoff: float) -> Array:
    """Return contacts (N, c) that count as closed half a period of the cutoff longer.

    So far the low-pass spreads the force of a foot into the time at which it is in the air.
    """
    reach = round(0.5 * rate / cutoff)
    return maximum_filter1d(contact, 2 * reach + 1, axis=0)
