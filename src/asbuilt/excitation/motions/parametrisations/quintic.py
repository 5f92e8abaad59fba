"""Quintic polynomials through free way points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.motions.quintic import QuinticMotion


@dataclass(frozen=True)
class Quintic(Parametrisation):
    """Quintic polynomials through `size` way points at equal times, at rest at both ends.

    Coefficients: positions of the `size` way points, then velocities and accelerations of the inner
    ones, in units of the time between two points and its square.
    """

    key = "quintic"
    size_name = "way points"
    density = 0.5

    def _times(self) -> Array:
        return np.linspace(0.0, self.duration, self.size)

    def _parts(self, coefficients: Array) -> tuple[Array, Array, Array]:
        m, n = self.size, coefficients.shape[1]
        step = self.duration / (m - 1)
        speed, change = np.zeros((m, n)), np.zeros((m, n))
        speed[1:-1] = coefficients[m : 2 * m - 2] / step
        change[1:-1] = coefficients[2 * m - 2 :] / step**2
        return coefficients[:m], speed, change

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return self.motion(np.eye(3 * self.size - 4)).derivative(t, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the motion through the way points."""
        q, qd, qdd = self._parts(coefficients)
        return QuinticMotion.through(q, self._times(), qd, qdd)

    @property
    def shortest_wave(self) -> float:
        """The time between two way points [s]."""
        return self.duration / (self.size - 1)

    @property
    def constant(self) -> Array:
        """Coefficients of the constant 1: equal way points at rest."""
        return np.concatenate([np.ones(self.size), np.zeros(2 * self.size - 4)])


PARAMETRISATIONS.register(Quintic.key, Quintic)
