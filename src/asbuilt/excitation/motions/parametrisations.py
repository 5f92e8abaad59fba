"""Families of motions that are linear in their coefficients: what a design chooses among."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.motions.bspline import BSplineMotion
from asbuilt.excitation.motions.fourier import FourierMotion, fourier_basis
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial
from asbuilt.excitation.motions.quintic import QuinticMotion


@dataclass(frozen=True)
class Parametrisation(ABC):
    """Map coefficients (n_basis, n_joints) linearly to a motion of `duration` seconds.

    `size` says how rich the family is.
    """

    duration: float
    size: int
    key: ClassVar[str]
    size_name: ClassVar[str]

    @abstractmethod
    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions at the times `t` (N,), shape
        (N, n_basis).
        """

    @abstractmethod
    def motion(self, coefficients: Array) -> Motion:
        """Return the motion with these coefficients."""

    @property
    @abstractmethod
    def shortest_wave(self) -> float:
        """About the shortest time in which a motion of the family goes there and back [s]."""

    @property
    @abstractmethod
    def constant(self) -> Array:
        """The coefficients (n_basis,) of standing still at 1."""

    def random(self, rng: np.random.Generator, n_joints: int) -> Array:
        """Return random coefficients that move every joint about 0, at no particular scale."""
        return rng.normal(size=(self.constant.size, n_joints))


@dataclass(frozen=True)
class Fourier(Parametrisation):
    """Fourier series with `size` harmonics, at rest at both ends (`FourierMotion`), repeated
    `periods` times.
    """

    periods: int = 1
    key = "fourier"
    size_name = "harmonics"

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return fourier_basis(t, self.duration / self.periods, self.size, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the series."""
        return FourierMotion(coefficients, self.duration / self.periods, self.periods)

    @property
    def shortest_wave(self) -> float:
        """Period of the highest harmonic [s]."""
        return self.duration / self.periods / self.size

    @property
    def constant(self) -> Array:
        """The first coefficient is the pose."""
        return np.concatenate([[1.0], np.zeros(2 * self.size - 2)])


@dataclass(frozen=True)
class BSpline(Parametrisation):
    """Quintic B-spline with `size` control points, at rest at both ends (`BSplineMotion`)."""

    key = "bspline"
    size_name = "control points"

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return BSplineMotion(np.zeros((self.size, 1)), self.duration).basis(t, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the spline."""
        return BSplineMotion(coefficients, self.duration)

    @property
    def shortest_wave(self) -> float:
        """Some two knots [s]."""
        return 2.0 * self.duration / max(self.size - 1, 1)

    @property
    def constant(self) -> Array:
        """All control points alike."""
        return np.ones(self.size)


@dataclass(frozen=True)
class Quintic(Parametrisation):
    """Quintic polynomials through `size` way points at equal times, whose positions, velocities and
    accelerations are free; at rest at both ends.

    Coefficients: positions of the `size` way points, then velocities and accelerations of the inner
    ones, in units of the time between two points and its square.
    """

    key = "quintic"
    size_name = "way points"

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
        """All way points alike, no velocity."""
        return np.concatenate([np.ones(self.size), np.zeros(2 * self.size - 4)])


@dataclass(frozen=True)
class PointToPoint(Parametrisation):
    """Straight moves between `size` poses with trapezoidal velocity, a third of each move for
    speeding up and a third for slowing down.

    `steps` are the times of the moves [s], equal where not given. What a controller makes of the
    poses is faster: `PointToPointMotion.within`.
    """

    steps: tuple[float, ...] = ()
    key = "point-to-point"
    size_name = "poses"

    def _steps(self) -> Array:
        equal = np.full(self.size - 1, self.duration / (self.size - 1))
        return np.array(self.steps) if self.steps else equal

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        steps = self._steps()
        edges = np.concatenate([[0.0], np.cumsum(steps)])
        move = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(steps) - 1)
        s, length = (t - edges[move]) / steps[move], steps[move]
        top, hard = 1.5, 4.5
        speeding, slowing = s < 1 / 3, s > 2 / 3
        if order == 0:
            part = np.where(
                speeding,
                hard * s**2 / 2,
                np.where(slowing, 1 - hard * (1 - s) ** 2 / 2, 0.25 + top * (s - 1 / 3)),
            )
        elif order == 1:
            part = np.where(speeding, hard * s, np.where(slowing, hard * (1 - s), top)) / length
        elif order == 2:
            part = np.where(speeding, hard, np.where(slowing, -hard, 0.0)) / length**2
        else:
            part = np.zeros_like(s)
        found = np.zeros((len(t), self.size))
        rows = np.arange(len(t))
        found[rows, move] = (1.0 if order == 0 else 0.0) - part
        found[rows, move + 1] = part
        return found

    def motion(self, coefficients: Array) -> Motion:
        """Return the moves at the given times."""
        edges = np.concatenate([[0.0], np.cumsum(self._steps())])
        breaks, pieces = [0.0], []
        for k, step in enumerate(self._steps()):
            start, way = coefficients[k], coefficients[k + 1] - coefficients[k]
            third, hard, top = step / 3, 4.5 / step**2, 1.5 / step
            breaks += [edges[k] + third, edges[k] + 2 * third, edges[k + 1]]
            pieces += [
                np.stack([hard / 2 * way, 0 * way, start]),
                np.stack([0 * way, top * way, start + 0.25 * way]),
                np.stack([-hard / 2 * way, top * way, start + 0.75 * way]),
            ]
        return PiecewisePolynomial(np.array(breaks), np.stack(pieces, axis=1))

    def retimed(self, steps: Array) -> PointToPoint:
        """Return the family with moves in proportion to `steps`, of the same duration."""
        scaled = np.asarray(steps) * self.duration / np.sum(steps)
        return replace(self, steps=tuple(float(step) for step in scaled))

    @property
    def shortest_wave(self) -> float:
        """Two moves [s]."""
        return 2 * float(self._steps().min())

    @property
    def constant(self) -> Array:
        """All poses alike."""
        return np.ones(self.size)


PARAMETRISATIONS: dict[str, type[Parametrisation]] = {
    kind.key: kind for kind in (Fourier, BSpline, Quintic, PointToPoint)
}
"""The linear families by key."""
