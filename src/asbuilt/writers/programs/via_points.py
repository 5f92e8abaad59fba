"""Few points that stand for a whole motion.

Knots of cubics, points of a spline, poses of a point-to-point motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import Motion

GRID_RATE = 1000.0
"""Rate at which points are compared with the motion [Hz]."""

KNOT_STEPS = (0.2, 0.004)
"""Longest and shortest time between knots of cubics [s]."""

SPLINE_STEPS = (0.5, 0.02)
"""Longest and shortest time between the points of a spline [s]."""

STRAIGHT = 1e-3
"""A stretch is straight in joint space when no joint leaves the line between its ends by more than
this [rad or m].
"""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Move straight to `pose` (n,) with top speeds `speed` (n,), then rest for `dwell` seconds."""

    pose: Array
    speed: Array
    dwell: float


def hermite_knots(motion: Motion, tolerance: float) -> Array:
    """Return equally spaced times between which the cubics that match position and velocity stay
    within `tolerance` [rad or m] of the motion.
    """

    def error(knots: Array) -> float:
        cubic = CubicHermiteSpline(knots, motion.derivative(knots), motion.derivative(knots, 1))
        return _largest_deviation(motion, cubic)

    return _equal_times(motion, error, tolerance, KNOT_STEPS, "cubics")


def spline_times(motion: Motion, tolerance: float) -> Array:
    """Return equally spaced times such that a cubic spline at rest at both ends through the poses
    then stays within `tolerance` of the motion.
    """

    def error(times: Array) -> float:
        return _largest_deviation(
            motion, CubicSpline(times, motion.derivative(times), bc_type="clamped")
        )

    return _equal_times(motion, error, tolerance, SPLINE_STEPS, "a spline")


def point_to_point_stretches(motion: Motion) -> tuple[Stretch, ...] | None:
    """Return the straight stretches between rests that the motion is made of, or None if it is not
    point-to-point.

    A rest is where every joint moves slower than it can start within one step of a 1 kHz grid.
    """
    t = _grid(motion)
    q, speed = motion.derivative(t), np.abs(motion.derivative(t, 1))
    slow = np.all(speed <= motion.peaks(2) / GRID_RATE + 1e-12, axis=1)
    slow[[0, -1]] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slow.astype(int), [0]])))
    rests = [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]
    if len(rests) < 3:
        return None
    stretches = []
    for (_, begin), (end, last) in pairwise(rests):
        a, b = q[begin], q[end]
        line = b - a
        along = np.clip((q[begin : end + 1] - a) @ line / max(line @ line, 1e-300), 0.0, 1.0)
        if np.max(np.abs(q[begin : end + 1] - a - along[:, None] * line)) > STRAIGHT:
            return None
        middle = (end + last) // 2
        stretches.append(
            Stretch(
                q[middle],
                speed[begin : end + 1].max(axis=0),
                max(0.0, float(t[last] - t[end]) - 1 / GRID_RATE),
            )
        )
    return tuple(stretches)


def _equal_times(
    motion: Motion,
    error: Callable[[Array], float],
    tolerance: float,
    steps: tuple[float, float],
    what: str,
) -> Array:
    longest, shortest = steps
    pieces = max(2, int(np.ceil(motion.duration / longest)))
    while True:
        times = np.linspace(0.0, motion.duration, pieces + 1)
        worst = error(times)
        if worst <= tolerance:
            return times
        if motion.duration / pieces < shortest:
            raise MotionError(
                f"points every {motion.duration / pieces:.3g} s do not suffice for {what}: off by"
                f" {worst:.2g} rad or m, allowed {tolerance:g}; the motion is not smooth, give one"
                " without jumps of velocity"
            )
        pieces = int(np.ceil(pieces * 1.25))


def _largest_deviation(motion: Motion, curve: CubicSpline | CubicHermiteSpline) -> float:
    t = _grid(motion)
    return float(np.max(np.abs(curve(t) - motion.derivative(t))))


def _grid(motion: Motion) -> Array:
    return np.linspace(0.0, motion.duration, int(np.ceil(motion.duration * GRID_RATE)) + 1)
