"""Points that reproduce a motion: knots of cubics, points of a spline, poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation import Motion

GRID_RATE = 1000.0
"""Rate at which points are compared with the motion [Hz]."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Move straight to `pose` (n,) with top speeds `speed` (n,), then rest for `dwell` seconds."""

    pose: Array
    speed: Array
    dwell: float


def choose_hermite_knots(motion: Motion, tolerance: float) -> Array:
    """Return equally spaced times whose cubics stay within `tolerance` of the motion.

    The cubics match position and velocity; the tolerance is in rad or m.
    """
    return _choose_equal_times(
        motion,
        lambda knots: CubicHermiteSpline(
            knots, motion.derivative(knots), motion.derivative(knots, 1)
        ),
        tolerance,
        (0.2, 0.004),
        "cubics",
    )


def choose_spline_times(motion: Motion, tolerance: float) -> Array:
    """Return equally spaced times whose cubic spline stays within `tolerance` of the motion.

    The spline passes the poses then and is at rest at both ends.
    """
    return _choose_equal_times(
        motion,
        lambda times: CubicSpline(times, motion.derivative(times), bc_type="clamped"),
        tolerance,
        (0.5, 0.02),
        "a spline",
    )


def divide_point_to_point(motion: Motion) -> tuple[Segment, ...] | None:
    """Return the straight segments between rests, or None for other motions.

    A rest is where every joint moves slower than it can start within one step of a 1 kHz grid.
    """
    t = _make_grid(motion)
    q = motion.derivative(t)
    speed = np.abs(motion.derivative(t, 1))
    slow = np.all(speed <= motion.peaks(2) / GRID_RATE + 1e-12, axis=1)
    slow[[0, -1]] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slow.astype(int), [0]])))
    rests = [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]
    if len(rests) < 3:
        return None
    segments = []
    for (_, begin), (end, last) in pairwise(rests):
        a = q[begin]
        b = q[end]
        line = b - a
        along = np.clip((q[begin : end + 1] - a) @ line / max(line @ line, 1e-300), 0.0, 1.0)
        # Largest deviation of a straight segment from the line in joint space [rad or m].
        if np.max(np.abs(q[begin : end + 1] - a - along[:, None] * line)) > 1e-3:
            return None
        segments.append(
            Segment(
                q[(end + last) // 2],
                speed[begin : end + 1].max(axis=0),
                max(0.0, float(t[last] - t[end]) - 1 / GRID_RATE),
            )
        )
    return tuple(segments)


def _choose_equal_times(
    motion: Motion,
    fit: Callable[[Array], CubicHermiteSpline | CubicSpline],
    tolerance: float,
    steps: tuple[float, float],
    what: str,
) -> Array:
    """Return the fewest equally spaced times whose curve, of `fit`, stays near the motion.

    `steps` are the longest and the shortest time between them [s].
    """
    longest, shortest = steps
    grid = _make_grid(motion)
    expected = motion.derivative(grid)
    intervals = max(2, int(np.ceil(motion.duration / longest)))
    while True:
        times = np.linspace(0.0, motion.duration, intervals + 1)
        worst = float(np.max(np.abs(fit(times)(grid) - expected)))
        if worst <= tolerance:
            return times
        if motion.duration / intervals < shortest:
            raise MotionError(
                f"{what} through points every {motion.duration / intervals:.3g} s deviate by"
                f" {worst:.2g} rad or m, allowed are {tolerance:g}; use a motion without jumps of"
                " velocity"
            )
        intervals = int(np.ceil(intervals * 1.25))


def _make_grid(motion: Motion) -> Array:
    return np.linspace(0.0, motion.duration, int(np.ceil(motion.duration * GRID_RATE)) + 1)
