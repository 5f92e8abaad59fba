"""Fifth-order polynomials between poses: smooth in position, velocity and acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import (
    STANDSTILL,
    Motion,
    check_limits_of_pace,
    check_way_points,
)
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial

PEAK_VELOCITY = 15.0 / 8.0
"""Largest rate of the rest-to-rest quintic over unit distance and time, at half time."""

PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)
"""Largest acceleration of the rest-to-rest quintic over unit distance and time."""


class QuinticMotion(PiecewisePolynomial):
    """Move along one quintic per pair of neighbouring poses (Craig 2005, section 7.3).

    Build it with `between`, `through` or `within`.
    """

    parametrisation = "quintic"

    @classmethod
    def between(
        cls,
        start: ArrayLike,
        end: ArrayLike,
        duration: float,
        *,
        start_velocity: ArrayLike = 0.0,
        end_velocity: ArrayLike = 0.0,
        start_acceleration: ArrayLike = 0.0,
        end_acceleration: ArrayLike = 0.0,
    ) -> Self:
        """Move from `start` to `end` (n,) in `duration` seconds, by default from rest to rest.

        From rest to rest, `q(t) = start + (end - start) (10 s^3 - 15 s^4 + 6 s^5)`, `s = t /
        duration`.

        Examples
        --------
        >>> motion = QuinticMotion.between([0.0, 1.0], [1.0, -1.0], duration=2.0)
        >>> q, qd, qdd = motion.at(1.0)
        >>> q.round(6).tolist(), qd.round(6).tolist()
        ([0.5, 0.0], [0.9375, -1.875])
        """
        poses = check_way_points([np.atleast_1d(start), np.atleast_1d(end)], "start and end")
        n = poses.shape[1]
        velocities = np.stack(
            [np.broadcast_to(start_velocity, (n,)), np.broadcast_to(end_velocity, (n,))]
        )
        accelerations = np.stack(
            [np.broadcast_to(start_acceleration, (n,)), np.broadcast_to(end_acceleration, (n,))]
        )
        return cls.through(poses, [0.0, duration], velocities, accelerations)

    @classmethod
    def through(
        cls,
        poses: ArrayLike,
        times: ArrayLike,
        velocities: ArrayLike | None = None,
        accelerations: ArrayLike | None = None,
    ) -> Self:
        """Pass `poses` (m, n) at `times` (m,), by default at rest; times start at 0.

        Velocities and accelerations have the shape of the poses.

        Raises
        ------
        MotionError
            If the times do not rise or shapes do not agree.
        """
        q = check_way_points(poses, "poses")
        t = np.asarray(times, dtype=np.float64)
        if t.shape != (q.shape[0],) or not np.all(np.diff(t) > 0):
            raise MotionError(
                f"{q.shape[0]} poses need as many rising times, got"
                f" {np.array2string(t, threshold=8)}"
            )
        v = np.zeros_like(q) if velocities is None else check_way_points(velocities, "velocities")
        a = (
            np.zeros_like(q)
            if accelerations is None
            else check_way_points(accelerations, "accelerations")
        )
        if v.shape != q.shape or a.shape != q.shape:
            raise MotionError(
                f"velocities and accelerations must have the shape of the poses, {q.shape}; got"
                f" {v.shape} and {a.shape}"
            )
        return cls(t - t[0], _solve_hermite(np.diff(t)[:, None], q, v, a))

    @classmethod
    def within(
        cls,
        poses: ArrayLike,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        jerk: ArrayLike = np.inf,
        dwell: float = 0.0,
    ) -> Self:
        """Stop at each of `poses` (m, n) for `dwell` seconds and move as fast as the limits allow.

        Limits are one number or one per joint.

        The time between two poses is the largest over the joints of `15/8 d / velocity`,
        `sqrt(10/sqrt(3) d / acceleration)` and `cbrt(60 d / jerk)`, d the distance; the slowest
        joint attains its limit exactly and the others arrive together with it.
        """
        q = check_way_points(poses, "poses")
        v, a, j = check_limits_of_pace(q.shape[1], velocity, acceleration, jerk, "motion")
        if not (np.isfinite(dwell) and dwell >= 0):
            raise MotionError(f"the dwell must be finite and not negative, got {dwell} s")
        distance = np.abs(np.diff(q, axis=0))
        distance[distance <= STANDSTILL] = 0.0
        # Largest jerk of the rest-to-rest quintic over unit distance and time, at both ends.
        steps = np.max(
            [
                PEAK_VELOCITY * distance / v,
                np.sqrt(PEAK_ACCELERATION * distance / a),
                np.cbrt(60.0 * distance / j),
            ],
            axis=(0, 2),
        )
        times = [0.0]
        stops = [q[0]]
        for k, step in enumerate(steps):
            if step > 0:
                times.append(times[-1] + step)
                stops.append(q[k + 1])
            if dwell > 0 and k < steps.size - 1:
                times.append(times[-1] + dwell)
                stops.append(q[k + 1])
        if len(times) < 2:
            raise MotionError("the poses are all the same and there is no dwell; nothing moves")
        return cls.through(np.array(stops), times)


def _solve_hermite(h: Array, q: Array, v: Array, a: Array) -> Array:
    """Return the coefficients (6, m, n), highest power first, that match q, v, a (m + 1, n).

    Pieces are h (m, 1) long.
    """
    q0 = q[:-1]
    v0 = v[:-1]
    a0 = a[:-1]
    v1 = v[1:]
    a1 = a[1:]
    d = q[1:] - q0
    c3 = (20 * d - (8 * v1 + 12 * v0) * h - (3 * a0 - a1) * h**2) / (2 * h**3)
    c4 = (-30 * d + (14 * v1 + 16 * v0) * h + (3 * a0 - 2 * a1) * h**2) / (2 * h**4)
    c5 = (12 * d - 6 * (v1 + v0) * h - (a0 - a1) * h**2) / (2 * h**5)
    return np.stack([c5, c4, c3, a0 / 2, v0, q0])


@dataclass(frozen=True)
class Quintic(Parametrisation):
    """Quintic polynomials through `size` way points at equal times, at rest at both ends.

    Coefficients: positions of the `size` way points, then velocities and accelerations of the inner
    ones, in units of the time between two points and its square.
    """

    key = "quintic"
    size_name = "way points"
    density = 0.5

    def _list_times(self) -> Array:
        return np.linspace(0.0, self.duration, self.size)

    def _split_coefficients(self, coefficients: Array) -> tuple[Array, Array, Array]:
        m = self.size
        n = coefficients.shape[1]
        step = self.duration / (m - 1)
        speed = np.zeros((m, n))
        change = np.zeros((m, n))
        speed[1:-1] = coefficients[m : 2 * m - 2] / step
        change[1:-1] = coefficients[2 * m - 2 :] / step**2
        return coefficients[:m], speed, change

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return self.motion(np.eye(3 * self.size - 4)).derivative(t, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the motion through the way points."""
        q, qd, qdd = self._split_coefficients(coefficients)
        return QuinticMotion.through(q, self._list_times(), qd, qdd)

    @property
    def shortest_wave(self) -> float:
        """The time between two way points [s]."""
        return self.duration / (self.size - 1)

    @property
    def constant(self) -> Array:
        """Coefficients of the constant 1: equal way points at rest."""
        return np.concatenate([np.ones(self.size), np.zeros(2 * self.size - 4)])


PARAMETRISATIONS.register(Quintic.key, Quintic)
