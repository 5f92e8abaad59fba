"""Cubic splines and roots, whose packages in scipy take longer to import than a fit does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from asbuilt.arrays import Array

HALVINGS = 60
"""Steps of bisection, after which an interval is as long as rounding."""


class CubicSpline:
    """The cubic spline through x (N, n) at increasing times t (N,), N >= 4, not-a-knot at its ends.

    The first two intervals have one cubic, and so do the last two (de Boor, A Practical Guide to
    Splines, 2001, chapter IV).
    """

    def __init__(self, t: Array, x: Array) -> None:
        step = np.diff(t)[:, None]
        slope = np.diff(x, axis=0) / step
        rate = _solve_rates(step, slope)
        # In the time u since the interval began: x + u (rate + u (bend + u jerk)).
        excess = (rate[:-1] + rate[1:] - 2.0 * slope) / step
        self._t = t
        self._powers = (excess / step, (slope - rate[:-1]) / step - excess, rate[:-1], x[:-1])

    def __call__(self, at: Array, derivative: int = 0) -> Array:
        """Return values (L, n), or derivatives; beyond the ends the outer cubics go on."""
        k = np.clip(np.searchsorted(self._t, at, side="right") - 1, 0, self._t.size - 2)
        u = (at - self._t[k])[:, None]
        powers = np.arange(3, derivative - 1, -1)
        value = np.zeros((at.size, self._powers[0].shape[1]))
        for power in powers.tolist():
            factor = float(np.prod(np.arange(power - derivative + 1, power + 1)))
            value *= u
            value += factor * self._powers[3 - power][k]
        return value


def _solve_rates(step: Array, slope: Array) -> Array:
    """Return the rates (N, n) at the knots by the steps (N - 1, 1) and slopes (N - 1, n) between.

    The second derivative is continuous, and at the second knot from either end the third.
    """
    from scipy.linalg import lapack  # noqa: PLC0415 - light start

    first = step[0] + step[1]
    last = step[-2] + step[-1]
    start = (step[0] + 2.0 * first) * step[1] * slope[0] + step[0] ** 2 * slope[1]
    end = step[-1] ** 2 * slope[-2] + (2.0 * last + step[-1]) * step[-2] * slope[-1]
    inner = 3.0 * (step[1:] * slope[:-1] + step[:-1] * slope[1:])
    below = np.concatenate([step[1:], [last]])[:, 0]
    above = np.concatenate([[first], step[:-1]])[:, 0]
    diagonal = np.concatenate([[step[1]], 2.0 * (step[:-1] + step[1:]), [step[-2]]])[:, 0]
    right = np.concatenate([[start / first], inner, [end / last]])
    return np.asarray(lapack.dgtsv(below, diagonal, above, right)[3])


def find_root(excess: Callable[[float], float], lowest: float, highest: float) -> float:
    """Return where a function whose signs differ at both ends is zero, by bisection.

    >>> round(find_root(lambda x: x * x - 2.0, 0.0, 2.0), 12)
    1.414213562373
    """
    negative = excess(lowest) < 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (lowest + highest)
        if (excess(middle) < 0.0) == negative:
            lowest = middle
        else:
            highest = middle
    return 0.5 * (lowest + highest)
