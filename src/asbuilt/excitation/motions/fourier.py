"""Finite Fourier series: periodic, band-limited motions that start and end at rest; random ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kinematics import draw_postures_within, find_first_posture
from asbuilt.errors import MotionError
from asbuilt.excitation.limits import MotionBounds, check_motion, make_open_error
from asbuilt.excitation.motions.motion import BasisMotion, Motion, check_way_points
from asbuilt.excitation.motions.parametrisation import (
    HARMONICS,
    PARAMETRISATIONS,
    SAFE_FREQUENCY,
    Parametrisation,
    useful_frequency,
)
from asbuilt.excitation.motions.point_to_point import PointToPointMotion


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

    def basis(self, t: ArrayLike, order: int = 0) -> Array:
        """Return the derivative of each basis function at the times `t` (N,), (N, 2 L - 1)."""
        return fourier_basis(t, self.period, self.n_harmonics, order)

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
        least, most = HARMONICS
        if bounds is None:
            return max(least, round(SAFE_FREQUENCY * duration / (periods or 1))), periods
        useful = useful_frequency(bounds)
        fast = useful > 1.01 * SAFE_FREQUENCY
        repeats = periods or (max(1, round(useful * duration / most)) if fast else 1)
        period = duration / repeats
        slow = max(least, round(SAFE_FREQUENCY * period))
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


Seed = np.random.Generator | int | None

SHRINKAGE = 0.85
"""By what factor amplitudes or accelerations are reduced each time the torque limit is exceeded."""

ATTEMPTS = 40
"""How often that is tried."""

CHECKED_RATE = 100.0
"""Rate at which torque and postures of a random motion are checked [Hz]."""


def random_fourier(
    model: RobotModel,
    rng: Seed = None,
    *,
    duration: float = 20.0,
    n_harmonics: int = 5,
    periods: int = 1,
    fraction: float = 0.9,
) -> FourierMotion:
    """Return a random Fourier motion that uses `fraction` of a limit of each joint.

    It is scaled until each joint reaches its position, velocity or acceleration limit.

    Coefficients are normal, alike for all harmonics; each joint's mean position is drawn where its
    amplitude allows. Limits that the description does not give come from
    `MotionBounds.assumed`. Where a torque limit is exceeded all amplitudes shrink. Where not
    every posture within the limits exists, it shrinks towards the posture of the description.

    Raises
    ------
    MotionError
        If the robot cannot hold its weight within the torque limits even at small amplitudes, or
        no postures exist about that of the description.
    """
    if n_harmonics < 2 or periods < 1:
        raise MotionError(
            f"a Fourier motion needs at least 2 harmonics and 1 period, got {n_harmonics} and"
            f" {periods}"
        )
    generator = np.random.default_rng(rng)
    bounds = MotionBounds.assumed(model, fraction)
    rows = generator.normal(size=(2 * n_harmonics - 1, model.n_joints))
    rows[0] = 0.0
    shape = FourierMotion(rows, duration / periods, periods)
    low, high = shape.extremes(0)
    scales = [
        (bounds.upper - bounds.lower) / (high - low),
        bounds.velocity / shape.peaks(1),
        bounds.acceleration / shape.peaks(2),
    ]
    scale = np.min([*scales, bounds.jerk / shape.peaks(3)], axis=0)
    place = generator.uniform(size=model.n_joints)
    home = find_first_posture(model)

    def motion(size: float) -> FourierMotion:
        coefficients = size * scale * rows
        free_low = bounds.lower - size * scale * low
        free_high = bounds.upper - size * scale * high
        centre = free_low + place * (free_high - free_low)
        coefficients[0] = centre if home is None else home + size * (centre - home)
        return FourierMotion(coefficients, shape.period, periods)

    size = 1.0
    for _ in range(ATTEMPTS):
        candidate = motion(size)
        if _closes(model, candidate) and _holds_torque(model, candidate, fraction):
            return candidate
        size *= SHRINKAGE
    raise _make_torque_error(model)


def random_point_to_point(
    model: RobotModel,
    rng: Seed = None,
    n_poses: int = 20,
    *,
    dwell: float = 0.25,
    fraction: float = 0.9,
) -> PointToPointMotion:
    """Return a point-to-point motion through `n_poses` random poses, within the limits.

    It uses `fraction` of them.

    Poses are uniform within the position limits; limits that the description does not give come
    from `MotionBounds.assumed`. Where a torque limit is exceeded the acceleration shrinks.
    Raises MotionError as `random_fourier` does.
    """
    if n_poses < 2:
        raise MotionError(f"a point-to-point motion needs at least 2 poses, got {n_poses}")
    generator = np.random.default_rng(rng)
    bounds = MotionBounds.assumed(model, fraction)
    poses = draw_postures_within(model, bounds.lower, bounds.upper, generator, n_poses)
    home = find_first_posture(model)
    size = 1.0
    for _ in range(ATTEMPTS):
        motion = PointToPointMotion.within(
            poses,
            velocity=np.sqrt(size) * bounds.velocity,
            acceleration=size * bounds.acceleration,
            dwell=dwell,
        )
        if home is not None and not _closes(model, motion):
            # Loops that close at two poses need not close on the way.
            poses = home + SHRINKAGE * (poses - home)
            continue
        if _holds_torque(model, motion, fraction):
            return motion
        size *= SHRINKAGE
        if size < SHRINKAGE ** (ATTEMPTS // 2):
            poses = draw_postures_within(model, bounds.lower, bounds.upper, generator, n_poses)
    raise _make_torque_error(model)


def _closes(model: RobotModel, motion: Motion) -> bool:
    """Return whether the robot has a posture all along a motion."""
    if find_first_posture(model) is None:
        return True
    q = motion.derivative(motion.sample_times(CHECKED_RATE), 0)
    return bool(model.joint_map.exists(q).all())


def _holds_torque(model: RobotModel, motion: Motion, fraction: float) -> bool:
    if not np.any(np.isfinite(MotionBounds.of(model).torque)):
        return True
    worst = check_motion(model, motion, CHECKED_RATE).worst["torque"]
    return worst is None or worst.margin >= 1 - fraction


def _make_torque_error(model: RobotModel) -> MotionError:
    limits = ", ".join(f"{limit:g}" for limit in MotionBounds.of(model).torque)
    if find_first_posture(model) is not None and not np.any(
        np.isfinite(MotionBounds.of(model).torque)
    ):
        return make_open_error(model)
    return MotionError(
        f"{model.name}: no random motion within the torque limits ({limits}) was found, however"
        " slow; check torque limits, masses and gravity, or raise `fraction`"
    )
