"""Straight moves between free poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial


@dataclass(frozen=True)
class PointToPoint(Parametrisation):
    """Straight moves between `size` poses; each third of a move speeds up, cruises, slows down.

    `steps` are the times of the moves [s], equal if not given. A controller moves between the same
    poses faster (`PointToPointMotion.within`).
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
        """Coefficients of the constant 1: equal poses."""
        return np.ones(self.size)


PARAMETRISATIONS.register(PointToPoint.key, PointToPoint)
