"""Fourier series with free coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.fourier import FourierMotion, fourier_basis
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.parametrisation import (
    PARAMETRISATIONS,
    RICHNESS,
    Parametrisation,
    useful_frequency,
)


@dataclass(frozen=True)
class Fourier(Parametrisation):
    """Fourier series with `size` harmonics, repeated `periods` times (`FourierMotion`).

    The motion is at rest at both ends.
    """

    periods: int = 1
    key = "fourier"
    size_name = "harmonics"
    band_limited = True

    @classmethod
    def of(cls, duration: float, size: int, periods: int = 1) -> Fourier:
        """Build the family."""
        return cls(duration, size, periods)

    @classmethod
    def usual_size(
        cls, duration: float, periods: int | None, bounds: MotionBounds | None = None
    ) -> tuple[int, int | None]:
        """Return harmonics and periods: up to the useful frequency, at most 16 in a period."""
        least, most = RICHNESS.harmonics
        if bounds is None:
            return max(least, round(RICHNESS.frequency * duration / (periods or 1))), periods
        useful = useful_frequency(bounds)
        fast = useful > 1.01 * RICHNESS.frequency
        repeats = periods or (max(1, round(useful * duration / most)) if fast else 1)
        period = duration / repeats
        slow = max(least, round(RICHNESS.frequency * period))
        return max(slow, min(most, round(useful * period))), repeats

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return fourier_basis(t, self.span, self.size, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the series."""
        return FourierMotion(coefficients, self.span, self.periods)

    @property
    def span(self) -> float:
        """Period [s]."""
        return self.duration / self.periods

    @property
    def shortest_wave(self) -> float:
        """Period of the highest harmonic [s]."""
        return self.span / self.size

    @property
    def constant(self) -> Array:
        """Coefficients of the constant 1; the first coefficient is the pose."""
        return np.concatenate([[1.0], np.zeros(2 * self.size - 2)])


PARAMETRISATIONS.register(Fourier.key, Fourier)
