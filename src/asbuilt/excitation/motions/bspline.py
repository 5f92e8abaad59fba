"""B-splines: local motions whose control points bound them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline as SciPySpline

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import BasisMotion, Motion, check_way_points
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial

DEGREE = 5
"""Degree of the splines: their jerk has neither jumps nor corners."""


class BSplineMotion(BasisMotion):
    """Move along a quintic B-spline on uniform knots, at rest at both ends.

    `coefficients` (m, n) are the control points in order: the first is the start pose and the last
    the end pose (each stands for three equal control points, which brings the motion to rest; de
    Boor 1978), the m - 2 between are free. The curve stays within the smallest and the largest
    control point of each joint, so control points within the position limits give a motion within
    them.

    Raises
    ------
    MotionError
        If there are fewer than two control points or the duration is not positive.

    Examples
    --------
    >>> motion = BSplineMotion([[0.0], [1.0], [-1.0], [0.0]], duration=4.0)
    >>> [x.round(12).tolist() for x in motion.at(4.0)]
    [[0.0], [0.0], [0.0]]
    """

    parametrisation = "b-spline"

    def __init__(self, coefficients: ArrayLike, duration: float) -> None:
        if not (np.isfinite(duration) and duration > 0):
            raise MotionError(f"the duration must be a positive number of seconds, got {duration}")
        self.coefficients = read_only(check_way_points(coefficients, "control points"))
        self._duration = float(duration)
        m = self.coefficients.shape[0]
        knots = np.linspace(0.0, self._duration, m + 4 - DEGREE + 1)
        padded = np.concatenate([np.zeros(DEGREE), knots, np.full(DEGREE, self._duration)])
        # Column i sums plain B-splines: the first three, one each in between, the last three.
        folding = np.zeros((m + 4, m))
        folding[:3, 0] = 1.0
        folding[np.arange(3, m + 1), np.arange(1, m - 1)] = 1.0
        folding[m + 1 :, m - 1] = 1.0
        self._functions = SciPySpline(padded, folding, DEGREE)

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self._duration

    def basis(self, t: ArrayLike, order: int = 0) -> Array:
        """Return the derivative of each basis function at the times `t` (N,), shape (N, m)."""
        return np.asarray(
            self._functions(np.atleast_1d(np.asarray(t, dtype=np.float64)), nu=order),
            dtype=np.float64,
        )

    @cached_property
    def pieces(self) -> PiecewisePolynomial:
        """The same motion as polynomials between the knots."""
        breaks = np.unique(self._functions.t)
        rows = [
            self.basis(breaks[:-1], k) @ self.coefficients / factorial(k)
            for k in range(DEGREE, -1, -1)
        ]
        return PiecewisePolynomial(breaks, np.stack(rows))

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the exact smallest and largest value of a derivative, two (n,)."""
        return self.pieces.extremes(order)


@dataclass(frozen=True)
class BSpline(Parametrisation):
    """Quintic B-spline with `size` control points, at rest at both ends (`BSplineMotion`)."""

    key = "bspline"
    size_name = "control points"
    density = 1.0

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return BSplineMotion(np.zeros((self.size, 1)), self.duration).basis(t, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the spline."""
        return BSplineMotion(coefficients, self.duration)

    @property
    def shortest_wave(self) -> float:
        """About two knots [s]."""
        return 2.0 * self.duration / max(self.size - 1, 1)

    @property
    def constant(self) -> Array:
        """Coefficients of the constant 1: equal control points."""
        return np.ones(self.size)


PARAMETRISATIONS.register(BSpline.key, BSpline)
