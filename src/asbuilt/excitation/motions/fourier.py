"""Finite Fourier series: periodic, band-limited motions that start and end at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import BasisMotion, Motion, check_way_points
from asbuilt.excitation.motions.parametrisation import (
    PARAMETRISATIONS,
    RICHNESS,
    Parametrisation,
    useful_frequency,
)


class FourierMotion(BasisMotion):
    r"""Move along a finite Fourier series, at rest at both ends.

    With `w = 2 pi / period` and L harmonics, the basis functions are (2 L - 1 of them)

    - `1`, whose coefficient is the pose at start and end,
    - `sin(l w t) / l - sin(w t)` for l = 2 ... L, with velocity `w (cos(l w t) - cos(w t))`,
    - `(1 - cos(l w t)) / l^2 - (1 - cos(w t))` for l = 2 ... L, with acceleration `w^2 (cos(l w t)
      - cos(w t))`.

    `coefficients` (2 L - 1, n) follows this order: row 0 the pose, rows 1 ... L - 1 the sines, rows
    L ... 2 L - 2 the cosines, all in rad or m. Each function but the first vanishes at the ends
    together with its velocity and acceleration, so any coefficients give a motion from rest to
    rest; it is the series of Swevers et al. (1997), `q = q0 + sum_l a_l / (l w) sin(l w t) - b_l /
    (l w) cos(l w t)`, with `sum_l a_l = 0` and `sum_l l b_l = 0` solved for the first harmonic.
    Unlike the series completed by a polynomial (Park 2006) it stays periodic - periods can be
    averaged and the noise measured from their scatter - and holds no frequency above L / period.

    Raises
    ------
    MotionError
        If there are fewer than two harmonics, an even number of rows, or the period or number of
        periods makes no sense.

    Examples
    --------
    >>> motion = FourierMotion([[0.5], [0.2], [0.1]], period=10.0)
    >>> motion.n_harmonics, [x.round(12).tolist() for x in motion.at(10.0)]
    (2, [[0.5], [0.0], [0.0]])
    """

    parametrisation = "fourier"

    def __init__(self, coefficients: ArrayLike, period: float, periods: int = 1) -> None:
        rows = check_way_points(coefficients, "Fourier coefficients", least=3)
        if rows.shape[0] % 2 == 0:
            raise MotionError(
                "L harmonics have 2 L - 1 rows of coefficients (pose, L - 1 sines, L - 1 cosines),"
                f" got {rows.shape[0]} rows"
            )
        if not (np.isfinite(period) and period > 0):
            raise MotionError(f"the period must be a positive number of seconds, got {period}")
        if periods != int(periods) or periods < 1:
            raise MotionError(
                f"a motion runs through a whole number of periods, at least 1; got {periods}"
            )
        self.coefficients = read_only(rows)
        self.period = float(period)
        self.periods = int(periods)

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.period * self.periods

    @property
    def n_harmonics(self) -> int:
        """Number of harmonics, L."""
        return int(self.coefficients.shape[0] + 1) // 2

    @property
    def fundamental(self) -> float:
        """Fundamental angular frequency w [rad/s]."""
        return 2 * np.pi / self.period

    @property
    def series(self) -> tuple[Array, Array, Array]:
        """`q0` (n,), `a` and `b` (L, n) of the series in the form of Swevers et al. (1997)."""
        sines = self.coefficients[1 : self.n_harmonics]
        cosines = self.coefficients[self.n_harmonics :]
        w = self.fundamental
        orders = np.arange(2, self.n_harmonics + 1)[:, None]
        a = w * np.vstack([-sines.sum(axis=0), sines])
        b = w * np.vstack([-cosines.sum(axis=0), cosines / orders])
        q0 = self.coefficients[0] + (b / (w * np.arange(1, self.n_harmonics + 1)[:, None])).sum(
            axis=0
        )
        return q0, a, b

    def basis(self, t: ArrayLike, order: int = 0) -> Array:
        """Return the derivative of each basis function at the times `t` (N,), (N, 2 L - 1)."""
        return fourier_basis(t, self.period, self.n_harmonics, order)

    def with_coefficients(self, coefficients: ArrayLike) -> FourierMotion:
        """Return the motion with other coefficients, shape (n_basis, n_joints)."""
        return FourierMotion(coefficients, self.period, self.periods)

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative, two (n,).

        Found on 64 points per shortest wave, then polished by Newton's method on the next
        derivative; off by less than 1e-9 of the peak.
        """
        t = np.linspace(0.0, self.period, 64 * self.n_harmonics + 1)
        values = self._evaluate(t, order)
        best = []
        for chosen in (np.argmin(values, axis=0), np.argmax(values, axis=0)):
            when = t[chosen]
            for _ in range(3):
                slope, curvature = (np.diagonal(self._evaluate(when, order + k)) for k in (1, 2))
                step = np.divide(slope, curvature, out=np.zeros_like(when), where=curvature != 0)
                when = when - np.clip(step, -t[1], t[1])
            best.append(np.diagonal(self._evaluate(when, order)))
        return np.minimum(values.min(axis=0), best[0]), np.maximum(values.max(axis=0), best[1])


def fourier_basis(t: ArrayLike, period: float, n_harmonics: int, order: int = 0) -> Array:
    """Return a derivative of the functions of `FourierMotion` at `t` (N,).

    Shape (N, 2 n_harmonics - 1).
    """
    if n_harmonics < 2:
        raise MotionError(
            f"a series at rest at both ends needs at least 2 harmonics, got {n_harmonics}"
        )
    w = 2 * np.pi / period
    harmonics = np.arange(1, n_harmonics + 1)
    # z_l = exp(i l w t) has derivatives (i l w)^order z_l; sine and cosine are its parts.
    first = np.exp(1j * w * (np.atleast_1d(np.asarray(t, dtype=np.float64)) % period))
    waves = (
        np.cumprod(np.broadcast_to(first[:, None], (first.size, n_harmonics)), axis=1)
        * (1j * harmonics * w) ** order
    )
    sines = waves.imag / harmonics
    cosines = ((1.0 if order == 0 else 0.0) - waves.real) / harmonics**2
    constant = np.full((first.size, 1), 1.0 if order == 0 else 0.0)
    return np.hstack([constant, sines[:, 1:] - sines[:, :1], cosines[:, 1:] - cosines[:, :1]])


@dataclass(frozen=True)
class Fourier(Parametrisation):
    """Fourier series with `size` harmonics, repeated `periods` times (`FourierMotion`).

    The motion is at rest at both ends.
    """

    key = "fourier"
    size_name = "harmonics"
    band_limited = True

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
