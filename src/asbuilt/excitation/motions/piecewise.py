"""Motions made of pieces: polynomials between breaks, splines, and motions one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from math import factorial
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly, make_interp_spline
from scipy.optimize import minimize

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import (
    QUANTITIES,
    TIME_TOLERANCE,
    Motion,
    check_limits_of_pace,
    check_way_points,
)

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


Ends = Literal["rest", "natural"]

_END_DERIVATIVES: dict[tuple[int, str], tuple[int, ...]] = {
    (3, "natural"): (2,),
    (5, "rest"): (1, 2),
    (5, "natural"): (3, 4),
}
"""Which derivatives vanish at both ends, by degree and kind of end."""

SHARPNESS = 30.0
"""Exponent of the norm that approximates the maximum while times are improved."""


class SplineMotion(PiecewisePolynomial):
    """Move along a spline through way points.

    Build it with `through` (given times) or `within` (given limits).
    """

    parametrisation = "spline"

    @classmethod
    def through(
        cls, way_points: ArrayLike, times: ArrayLike, *, degree: int = 5, ends: Ends = "rest"
    ) -> Self:
        """Pass `way_points` (m, n) at `times` (m,), which start at 0, with degree 3 or 5.

        `ends` says what vanishes at both ends: velocity and acceleration ("rest", degree 5), or the
        derivatives that make the curve smoothest ("natural": acceleration for degree 3; third and
        fourth derivative for degree 5).

        Raises
        ------
        MotionError
            If the times do not rise, shapes do not agree, or degree and ends do not go together.

        Examples
        --------
        >>> motion = SplineMotion.through([[0.0], [1.0], [0.5]], [0.0, 1.0, 2.0])
        >>> [abs(x).max().round(9).item() for x in motion.at([0.0, 2.0])[1:]]
        [0.0, 0.0]
        """
        q = check_way_points(way_points)
        t = np.asarray(times, dtype=np.float64)
        if t.shape != (q.shape[0],) or not np.all(np.diff(t) > 0) or not np.all(np.isfinite(t)):
            raise MotionError(
                f"{q.shape[0]} way points need as many rising times, got"
                f" {np.array2string(t, threshold=8)}"
            )
        vanishing = _END_DERIVATIVES.get((degree, ends))
        if vanishing is None:
            known = ", ".join(f"degree {d} {e!r}" for d, e in _END_DERIVATIVES)
            raise MotionError(
                f"there is no spline of degree {degree} with ends {ends!r}; choose from {known}"
            )
        if degree == 5 and ends == "natural" and t.size < 3:
            raise MotionError(
                "a natural quintic spline needs at least 3 way points; give more, or ends='rest'"
            )
        knots = t - t[0]
        padded = np.concatenate([np.zeros(degree), knots, np.full(degree, knots[-1])])
        zeros: Any = [(order, np.zeros(q.shape[1])) for order in vanishing]
        curve = make_interp_spline(t - t[0], q, k=degree, t=padded, bc_type=(zeros, zeros))
        return cls(
            knots, np.stack([curve(knots[:-1], nu=k) / factorial(k) for k in range(degree, -1, -1)])
        )

    @classmethod
    def within(
        cls,
        way_points: ArrayLike,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        jerk: ArrayLike = np.inf,
    ) -> Self:
        """Pass `way_points` (m, n) in a short time, from rest to rest, within the limits.

        Limits are one number or one per joint.

        The times between way points start from the limits of each step alone and are improved by a
        quasi-Newton method (L-BFGS) on a smooth stand-in for the duration; then the whole is scaled
        so that one limit is reached exactly, since velocity falls with the scale of time,
        acceleration with its square and jerk with its cube. The shorter of the two is returned; it
        is not proven optimal.
        """
        q = check_way_points(way_points)
        limits = check_limits_of_pace(q.shape[1], velocity, acceleration, jerk, "spline")
        d = np.abs(np.diff(q, axis=0))
        steps = np.max(
            [np.power(d / limit, 1 / k) for k, limit in enumerate(limits, start=1)], axis=(0, 2)
        )
        if not np.any(steps > 0):
            raise MotionError("the way points are all the same; nothing moves")
        steps = np.maximum(steps, 1e-2 * steps.max())

        def times(logs: Array) -> Array:
            return np.concatenate([[0.0], np.cumsum(np.exp(logs))])

        def factors(logs: Array) -> Array:
            return _find_time_factors(cls.through(q, times(logs)), limits)

        def smooth_duration(logs: Array) -> float:
            return float(
                np.log(np.exp(logs).sum()) + np.log(np.sum(factors(logs) ** SHARPNESS)) / SHARPNESS
            )

        start = np.log(steps)
        bounds = list(zip(start - np.log(4), start + np.log(4), strict=True))
        # Most iterations of that improvement.
        found = minimize(
            smooth_duration,
            start,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 40},
        ).x
        scaled = [times(logs) * factors(logs).max() for logs in (start, found)]
        return cls.through(q, min(scaled, key=lambda t: float(t[-1])))


def _find_time_factors(motion: PiecewisePolynomial, limits: list[Array]) -> Array:
    """Return the factor of time that each limit needs in each piece and joint, flat.

    The `limits` bound velocity, acceleration and jerk.
    """
    needed = []
    for order, limit in enumerate(limits, start=1):
        if np.any(np.isfinite(limit)):
            low, high = motion.extremes_per_piece(order)
            needed.append(np.power(np.maximum(-low, high).clip(min=0.0) / limit, 1 / order).ravel())
    return np.concatenate(needed)
