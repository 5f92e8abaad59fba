"""Motions: joint positions as functions of time whose derivatives are known exactly."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError

QUANTITIES = ("position", "velocity", "acceleration", "jerk")
"""Names of the time derivatives of a motion; the index is the order."""

JUMPING = ("point-to-point",)
"""Parametrisations whose acceleration jumps."""

MOST_SAMPLES = 10_000_000
"""Samples of the longest motion that is sampled; three hours at 1 kHz."""
TIME_TOLERANCE = 1e-9
"""Times may leave the interval of a motion by this fraction of its duration (rounding).

They are clipped to it.
"""

STANDSTILL = 1e-12
"""Poses that differ by no more than this in every joint [rad or m] are the same pose."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Hold a motion sampled in time: `t` (N,) s.

    `q`, `qd`, `qdd` (N, n) in rad or m and their derivatives; read-only.

    Raises
    ------
    MotionError
        If shapes do not agree.
    """

    t: Array
    q: Array
    qd: Array
    qdd: Array

    def __post_init__(self) -> None:
        for name in ("t", "q", "qd", "qdd"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        shape = (self.t.size, self.q.shape[-1])
        for name in ("q", "qd", "qdd"):
            if getattr(self, name).shape != shape:
                raise MotionError(
                    f"{name} of a trajectory must have shape {shape} to go with {self.t.size}"
                    f" times, got {getattr(self, name).shape}"
                )

    def __repr__(self) -> str:
        return f"Trajectory({self.n_samples} samples, {self.n_joints} joints, {self.t[-1]:g} s)"

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])


class Motion(ABC):
    """Move n joints from time 0 to `duration`.

    A subclass says how with `duration`, `n_joints` and `_evaluate`.

    `derivative(t, k)` is the k-th time derivative of the joint positions, exactly: no motion here
    is differentiated numerically.
    """

    parametrisation: str
    """Kind of motion."""

    @property
    @abstractmethod
    def duration(self) -> float:
        """Time from start to end [s]."""

    @property
    @abstractmethod
    def n_joints(self) -> int:
        """Number of joints."""

    @abstractmethod
    def _evaluate(self, t: Array, order: int) -> Array:
        """Return the derivative of this order at times `t` (N,), all valid, (N, n_joints)."""

    def derivative(self, t: ArrayLike, order: int = 0) -> Array:
        """Return `d^order q / dt^order` at the times `t`.

        Shape (n,) for one time, (N, n) for N times.

        Raises
        ------
        MotionError
            If a time lies outside 0 ... `duration`.
        """
        times = np.asarray(t, dtype=np.float64)
        flat = np.atleast_1d(times)
        slack = TIME_TOLERANCE * self.duration
        inside = (flat >= -slack) & (flat <= self.duration + slack)
        if not np.all(inside):
            raise MotionError(
                f"t = {flat[~inside][0]:g} s is outside the motion, which lasts from 0 to"
                f" {self.duration:g} s"
            )
        values = self._evaluate(np.clip(flat, 0.0, self.duration), order)
        return values[0] if times.ndim == 0 else values

    def at(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Return q, qd and qdd at the times `t`, each (n,) for one time or (N, n)."""
        return self.derivative(t, 0), self.derivative(t, 1), self.derivative(t, 2)

    @property
    def start(self) -> Array:
        """Joint positions at time 0, shape (n,)."""
        return self.derivative(0.0)

    @property
    def end(self) -> Array:
        """Joint positions at the end, shape (n,)."""
        return self.derivative(self.duration)

    def sample_times(self, rate: float) -> Array:
        """Return the times `0, 1/rate, 2/rate, ...` up to the end.

        The end itself is among them if it is a multiple of the period.
        """
        if not (np.isfinite(rate) and rate > 0):
            raise MotionError(
                f"the rate must be a positive number of samples per second, got {rate}"
            )
        if self.duration * rate > MOST_SAMPLES:
            raise MotionError(
                f"{self.duration:g} s at {rate:g} Hz are {self.duration * rate:.3g} samples; at"
                f" most {MOST_SAMPLES:.0e} are written"
            )
        return (
            np.arange(
                int(np.floor(self.duration * rate * (1 + TIME_TOLERANCE) + TIME_TOLERANCE)) + 1
            )
            / rate
        )

    def sample(self, rate: float) -> Trajectory:
        """Return the motion at `rate` samples per second."""
        t = self.sample_times(rate)
        return Trajectory(t, *self.at(t))

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative, two (n,).

        Found on a grid of at least 1 kHz and 2000 points; subclasses may be exact.
        """
        values = self.derivative(
            np.linspace(0.0, self.duration, max(2001, int(self.duration * 1000) + 1)), order
        )
        return values.min(axis=0), values.max(axis=0)

    def peaks(self, order: int) -> Array:
        """Return the largest absolute value of a derivative over the whole motion, shape (n,)."""
        low, high = self.extremes(order)
        return np.maximum(np.abs(low), np.abs(high))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.n_joints} joints, {self.duration:g} s)"

    def slowed(self, factor: float) -> TimeScaled:
        """Return the same path in `factor` times the time.

        Velocities fall by `factor`, accelerations by its square.
        """
        return TimeScaled(self, factor)


class BasisMotion(Motion):
    """Move linearly in coefficients.

    `q(t) = basis(t, 0) @ coefficients`, and so do all derivatives.

    `coefficients` has shape (n_basis, n_joints), one column per joint; the basis is the same for
    every joint. A design can therefore differentiate anything with respect to the coefficients
    through `basis`.
    """

    coefficients: Array

    @abstractmethod
    def basis(self, t: ArrayLike, order: int = 0) -> Array:
        """Return the derivative of each basis function at the times `t` (N,), (N, n_basis)."""

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.coefficients.shape[1])

    def _evaluate(self, t: Array, order: int) -> Array:
        return np.asarray(self.basis(t, order) @ self.coefficients)


class TimeScaled(Motion):
    """Run another motion slower (`factor` > 1) or faster (< 1): `q(t) = q_other(t / factor)`.

    Examples
    --------
    >>> from asbuilt.excitation.motions.quintic import QuinticMotion
    >>> slow = QuinticMotion.between([0.0], [1.0], duration=2.0).slowed(10)
    >>> slow.duration, round(float(slow.peaks(1)[0]), 6)
    (20.0, 0.09375)
    """

    def __init__(self, motion: Motion, factor: float) -> None:
        if not (np.isfinite(factor) and factor > 0):
            raise MotionError(f"a motion can be slowed by a positive factor only, got {factor}")
        self.motion = motion
        self.factor = float(factor)
        self.parametrisation = motion.parametrisation

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.motion.duration * self.factor

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.motion.n_joints

    def _evaluate(self, t: Array, order: int) -> Array:
        return self.motion.derivative(t / self.factor, order) / self.factor**order

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative, two (n,)."""
        low, high = self.motion.extremes(order)
        return low / self.factor**order, high / self.factor**order


def check_way_points(points: ArrayLike, what: str = "way points", least: int = 2) -> Array:
    """Return `points` as a finite (m, n) array of at least `least` rows, or raise MotionError."""
    array = np.array(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[0] < least or array.shape[1] == 0:
        raise MotionError(
            f"{what} must be an array of at least {least} rows, one column per joint; got shape"
            f" {array.shape}"
        )
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        raise MotionError(
            f"{what}: row {bad[0, 0] + 1}, joint {bad[0, 1] + 1} is {array[tuple(bad[0])]}, not a"
            " finite number"
        )
    return array


def check_limits_of_pace(
    n_joints: int, velocity: ArrayLike, acceleration: ArrayLike, jerk: ArrayLike, what: str
) -> list[Array]:
    """Return limits of the first three derivatives (n_joints,); raises MotionError without any."""
    limits = [
        check_limit_array(limit, n_joints, name)
        for limit, name in zip((velocity, acceleration, jerk), QUANTITIES[1:], strict=True)
    ]
    if not np.all(np.isfinite(np.min(limits, axis=0))):
        raise MotionError(
            "a joint without a finite velocity, acceleration or jerk limit has no fastest"
            f" {what}; give one for every joint"
        )
    return limits


def check_limit_array(limit: ArrayLike, n_joints: int, quantity: str) -> Array:
    """Return a limit as (n_joints,) positive numbers (infinite allowed), or raise MotionError."""
    array = np.asarray(limit, dtype=np.float64)
    if array.ndim > 1 or (array.ndim == 1 and array.size not in (1, n_joints)):
        raise MotionError(
            f"the {quantity} limit must be one number or one per joint ({n_joints}), got shape"
            f" {array.shape}"
        )
    array = np.broadcast_to(array, (n_joints,)).copy()
    if not np.all(array > 0):
        j = int(np.argmin(np.where(np.isnan(array), -np.inf, array)))
        raise MotionError(f"the {quantity} limit of joint {j + 1} must be positive, got {array[j]}")
    return array
