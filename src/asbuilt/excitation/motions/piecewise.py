"""Motions made of pieces: polynomials between breaks, and motions one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import QUANTITIES, TIME_TOLERANCE, Motion

JOIN_TOLERANCE = 1e-9
"""Largest jump of position and velocity between two motions that are joined, in rad, m and their
rates.
"""


class PiecewisePolynomial(Motion):
    """Move along polynomials between `breaks` (m + 1,), which start at 0.

    All joints share the breaks.

    `coefficients` has shape (degree + 1, m, n), highest power first: in piece i, `q(t) = sum_k
    coefficients[k, i] (t - breaks[i])^(degree - k)`. At a break the later piece is evaluated.

    Raises
    ------
    MotionError
        If the breaks do not rise from 0, or shapes do not agree.
    """

    parametrisation = "piecewise polynomial"

    def __init__(self, breaks: ArrayLike, coefficients: ArrayLike) -> None:
        self.breaks = read_only(breaks)
        self.coefficients = read_only(coefficients)
        if (
            self.breaks.ndim != 1
            or self.breaks.size < 2
            or self.breaks[0] != 0.0
            or not np.all(np.diff(self.breaks) > 0)
        ):
            raise MotionError(
                "the breaks of a motion must rise from 0, got"
                f" {np.array2string(self.breaks, threshold=8)}"
            )
        if self.coefficients.ndim != 3 or self.coefficients.shape[1] != self.breaks.size - 1:
            raise MotionError(
                f"{self.breaks.size - 1} polynomial pieces need coefficients of shape (degree + 1,"
                f" {self.breaks.size - 1}, n_joints), got {self.coefficients.shape}"
            )
        if not np.all(np.isfinite(self.coefficients)):
            raise MotionError(
                "a polynomial coefficient is not finite; check way points and durations"
            )

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return float(self.breaks[-1])

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.coefficients.shape[2])

    @cached_property
    def _polynomial(self) -> PPoly:
        return PPoly(self.coefficients, self.breaks)

    def _evaluate(self, t: Array, order: int) -> Array:
        return np.asarray(self._polynomial(t, nu=order), dtype=np.float64)

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative, two (n,).

        Exact: they are reached at a break, from either side, or where the next derivative
        vanishes.
        """
        low, high = self.extremes_per_piece(order)
        return low.min(axis=0), high.max(axis=0)

    def extremes_per_piece(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative in each piece, two (m, n)."""
        curve = self._polynomial if order == 0 else self._polynomial.derivative(order)
        c = np.asarray(curve.c, dtype=np.float64)
        h = np.diff(self.breaks)[:, None]
        ends = np.zeros_like(c[0])
        for row in c:
            ends = ends * h + row
        low = np.minimum(c[-1], ends)
        high = np.maximum(c[-1], ends)
        if c.shape[0] < 3:
            return low, high
        slope = curve.derivative()
        for j in range(self.n_joints):
            roots = np.asarray(
                PPoly(slope.c[:, :, j], self.breaks).roots(discontinuity=False, extrapolate=False)
            )
            roots = roots[np.isfinite(roots)]
            if roots.size == 0:
                continue
            piece = np.clip(
                np.searchsorted(self.breaks, roots, side="right") - 1, 0, self.breaks.size - 2
            )
            values = np.zeros(roots.size)
            for row in c[:, :, j]:
                values = values * (roots - self.breaks[piece]) + row[piece]
            np.minimum.at(low[:, j], piece, values)
            np.maximum.at(high[:, j], piece, values)
        return low, high


class Concatenated(Motion):
    """Run motions one after the other, with rests of `dwell` seconds (one, or one per gap).

    At the instant where two motions meet, the later one is evaluated.

    Raises
    ------
    MotionError
        If the end of a motion is not the start of the next, in position and velocity, or a dwell
        starts while a joint moves.

    Examples
    --------
    >>> from asbuilt.excitation.motions.quintic import QuinticMotion
    >>> there = QuinticMotion.between([0.0], [1.0], duration=2.0)
    >>> back = QuinticMotion.between([1.0], [0.0], duration=2.0)
    >>> Concatenated([there, back], dwell=0.5).duration
    4.5
    """

    parametrisation = "concatenated"

    def __init__(self, motions: Sequence[Motion], dwell: ArrayLike = 0.0) -> None:
        if not motions:
            raise MotionError("there is no motion to concatenate; give at least one")
        dwells = np.broadcast_to(np.asarray(dwell, dtype=np.float64), (len(motions) - 1,))
        if np.any(dwells < 0) or not np.all(np.isfinite(dwells)):
            raise MotionError(f"dwell times must be finite and not negative, got {dwells.tolist()}")
        for k, (earlier, later) in enumerate(pairwise(motions)):
            _check_join(k, earlier, later, float(dwells[k]))
        self.motions = tuple(motions)
        durations = np.array([motion.duration for motion in motions])
        self.starts = read_only(np.concatenate([[0.0], np.cumsum(durations[:-1] + dwells)]))
        self._ends = self.starts + durations

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return float(self._ends[-1])

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.motions[0].n_joints

    def _evaluate(self, t: Array, order: int) -> Array:
        values = np.zeros((t.size, self.n_joints))
        which = np.searchsorted(self.starts, t, side="right") - 1
        for k, motion in enumerate(self.motions):
            rows = np.flatnonzero(which == k)
            local = t[rows] - self.starts[k]
            resting = local > motion.duration * (1 + TIME_TOLERANCE)
            values[rows[~resting]] = motion.derivative(local[~resting], order)
            if order == 0:
                values[rows[resting]] = motion.end
        return values

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative, two (n,)."""
        found = [motion.extremes(order) for motion in self.motions]
        return np.min([low for low, _ in found], axis=0), np.max(
            [high for _, high in found], axis=0
        )


def _check_join(k: int, earlier: Motion, later: Motion, dwell: float) -> None:
    if earlier.n_joints != later.n_joints:
        raise MotionError(
            f"motion {k + 1} moves {earlier.n_joints} joints, motion {k + 2} moves"
            f" {later.n_joints}; they cannot follow each other"
        )
    for order in (0, 1):
        before = earlier.derivative(earlier.duration, order)
        after = later.derivative(0.0, order)
        jump = np.abs(after - before)
        j = int(np.argmax(jump))
        if jump[j] > JOIN_TOLERANCE:
            raise MotionError(
                f"motion {k + 1} ends with {QUANTITIES[order]} {before[j]:g} of joint {j + 1},"
                f" motion {k + 2} starts with {after[j]:g}; put a QuinticMotion.between the two"
            )
        if order == 1 and dwell > 0 and np.max(np.abs(before)) > JOIN_TOLERANCE:
            raise MotionError(
                f"motion {k + 1} is still moving when a dwell of {dwell:g} s starts; end it at rest"
                " or set the dwell to 0"
            )
