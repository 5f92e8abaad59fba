"""Cubic splines through samples, with the digits of SciPy and without its import."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array


@dataclass(frozen=True, slots=True, eq=False)
class CubicSpline:
    """Hold the cubic spline through samples, whose third derivative is continuous next to the ends.

    (De Boor, A Practical Guide to Splines, 1978, chapter IV: "not-a-knot".)

    Parameters
    ----------
    times
        Times of the samples (N,), N at least 2; they increase.
    coefficients
        Of the powers 0 to 3 of the time since the last sample, shape (4, N - 1, n).

    >>> t = np.linspace(0.0, 1.0, 5)
    >>> float(CubicSpline.through(t, t[:, None] ** 3)(np.array([0.3]))[0, 0]).__round__(12)
    0.027
    """

    times: Array
    coefficients: Array

    @classmethod
    def through(cls, times: Array, x: Array) -> CubicSpline:
        """Return the spline through x (N, n)."""
        times = np.asarray(times, dtype=np.float64)
        step = np.diff(times)[:, None]
        slope = np.diff(x, axis=0) / step
        rate = _find_rates(times, step, slope)
        bend = (rate[:-1] + rate[1:] - 2.0 * slope) / step
        coefficients = x[:-1], rate[:-1], (slope - rate[:-1]) / step - bend, bend / step
        return cls(times, np.array(coefficients))

    def __call__(self, at: Array, derivative: int = 0) -> Array:
        """Return the values at some times (M,), or their derivative, up to the third, (M, n)."""
        interval = np.searchsorted(self.times, at, side="right") - 1
        interval = np.clip(interval, 0, len(self.times) - 2)
        d = (at - self.times[interval])[:, None]
        x0, x1, x2, x3 = self.coefficients[:, interval]
        # Powers in ascending order: the digits are SciPy's.
        if derivative == 0:
            return np.asarray(x0 + x1 * d + x2 * d**2 + x3 * (d * d * d))
        if derivative == 1:
            return np.asarray(x1 + x2 * d * 2.0 + x3 * (d * d) * 3.0)
        if derivative == 2:
            return np.asarray(x2 * 2.0 + x3 * d * 6.0)
        return np.asarray(x3 * 6.0)


def _find_rates(times: Array, step: Array, slope: Array) -> Array:
    """Return the derivatives (N, n) at the samples, by steps (N - 1, 1) and slopes between them."""
    if len(step) == 1:
        return np.concatenate([slope, slope])
    if len(step) == 2:
        # A parabola: the slopes between samples are its derivatives halfway.
        curvature = 2.0 * (slope[1] - slope[0]) / (step[0] + step[1])
        start = slope[0] - 0.5 * curvature * step[0]
        return np.stack([start, start + curvature * step[0], start + curvature * step.sum()])
    from scipy.linalg import solve_banded  # noqa: PLC0415 - light start

    # The second derivative is continuous at each sample but the ends.
    bands = np.zeros((3, len(step) + 1))
    bands[0, 2:] = step[:-1, 0]
    bands[1, 1:-1] = 2.0 * (step[:-1, 0] + step[1:, 0])
    bands[2, :-2] = step[1:, 0]
    right = np.empty((len(step) + 1, slope.shape[1]))
    right[1:-1] = 3.0 * (step[1:] * slope[:-1] + step[:-1] * slope[1:])
    # The third one next to the ends, less a multiple of the row before, so that three bands do.
    first = times[2] - times[0]
    last = times[-1] - times[-3]
    bands[1, 0] = step[1, 0]
    bands[0, 1] = first
    right[0] = _close_end(first, step[:2, 0], slope[:2])
    bands[1, -1] = step[-2, 0]
    bands[2, -2] = last
    right[-1] = _close_end(last, step[:-3:-1, 0], slope[:-3:-1])
    return np.asarray(solve_banded((1, 1), bands, right, check_finite=False))


def _close_end(both: float, step: Array, slope: Array) -> Array:
    """Return the right side (n,) of the row of an end, whose two steps are `both` together."""
    return np.asarray(
        ((step[0] + 2.0 * both) * step[1] * slope[0] + step[0] ** 2 * slope[1]) / both
    )
