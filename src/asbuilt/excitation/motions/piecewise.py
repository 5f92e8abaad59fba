"""Piecewise polynomials in time: what quintic, point-to-point and spline motions are made of."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import Motion


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
        low, high = np.minimum(c[-1], ends), np.maximum(c[-1], ends)
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
