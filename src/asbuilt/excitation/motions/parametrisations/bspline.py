"""Quintic B-splines with free control points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.motions.bspline import BSplineMotion
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation


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
