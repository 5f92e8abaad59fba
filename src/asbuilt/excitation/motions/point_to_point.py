"""Point-to-point motion between poses, as controllers make it, and its pace within limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Mask
from asbuilt.errors import MotionError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import (
    STANDSTILL,
    Motion,
    check_limit_array,
    check_way_points,
)
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial
from asbuilt.excitation.state_constraint import StateConstraint

CHECK_RATE = 1000.0
"""Rate of the grid on which a motion must keep its constraints [Hz]."""
SLOWING = 0.93
SLOWEST = 0.1
"""By what factor a move is slowed at a time, and at which share of its speed that is given up."""


class PointToPointMotion(PiecewisePolynomial):
    """Move straight in joint space from pose to pose, all joints in step.

    The velocity is a trapezoid or a triangle.
    """

    parametrisation = "point-to-point"

    @classmethod
    def within(
        cls,
        poses: ArrayLike,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        dwell: ArrayLike = 0.0,
        pace: ArrayLike = 1.0,
    ) -> Self:
        """Visit `poses` (m, n) as fast as `velocity` and `acceleration` allow, with rests `dwell`.

        Limits are one number or one per joint.

        All joints follow one profile s(t) from 0 to 1: `s'' = a`, 0 and `-a` in turn, with `s' <=
        v`, where `v = min_j velocity_j / d_j` and `a = min_j acceleration_j / d_j`, d the distances
        (Biagiotti & Melchiorri 2008, section 3.2). With `v^2 < a` the velocity is a trapezoid, `T =
        1/v + v/a`; otherwise a triangle, `T = 2 / sqrt(a)`. The limiting joint attains its limit
        exactly. `dwell` is one number for every pose after the first but the last, or one per such
        pose (m - 2,); repeated poses take no time besides their dwell. `pace` is the share of the
        velocity that is used, for all moves or one per move (m - 1,), with its square of the
        acceleration: the same move, slower.

        Raises
        ------
        MotionError
            If a limit is not positive, or nothing moves.

        Examples
        --------
        >>> motion = PointToPointMotion.within([[0.0], [1.0]], velocity=0.5, acceleration=1.0)
        >>> motion.duration, motion.peaks(1).tolist(), motion.peaks(2).tolist()
        (2.5, [0.5], [1.0])
        """
        q = check_way_points(poses, "poses")
        n = q.shape[1]
        v_max = check_limit_array(velocity, n, "velocity")
        a_max = check_limit_array(acceleration, n, "acceleration")
        if not np.all(np.isfinite(a_max)):
            raise MotionError(
                "point-to-point motion needs a finite acceleration limit for every joint, got"
                f" {a_max.tolist()}"
            )
        dwells = np.broadcast_to(np.asarray(dwell, dtype=np.float64), (q.shape[0] - 2,))
        if np.any(dwells < 0) or not np.all(np.isfinite(dwells)):
            raise MotionError(f"dwell times must be finite and not negative, got {dwells.tolist()}")
        paces = np.broadcast_to(np.asarray(pace, dtype=np.float64), (q.shape[0] - 1,))
        if not np.all((paces > 0) & (paces <= 1)):
            raise MotionError(
                f"the pace of a move must lie above 0 and at most at 1, got {paces.tolist()}"
            )
        pieces: list[tuple[float, Array]] = []
        for k in range(q.shape[0] - 1):
            d = q[k + 1] - q[k]
            moving = np.abs(d) > STANDSTILL
            if np.any(moving):
                v = float(np.min(v_max[moving] / np.abs(d[moving]))) * paces[k]
                a = float(np.min(a_max[moving] / np.abs(d[moving]))) * paces[k] ** 2
                ramp = min(v / a, 1 / np.sqrt(a))
                cruise = max(1 / (a * ramp) - ramp, 0.0) if v * v < a else 0.0
                pieces += _shape_move(q[k], q[k + 1], a, ramp, cruise)
            if k < dwells.size and dwells[k] > 0:
                pieces.append((float(dwells[k]), np.stack([0 * d, 0 * d, q[k + 1]])))
        if not pieces:
            raise MotionError("the poses are all the same and there is no dwell; nothing moves")
        return cls(*_join_pieces(pieces))


def _shape_move(
    start: Array, end: Array, a: float, ramp: float, cruise: float
) -> list[tuple[float, Array]]:
    """Return duration and coefficients (3, n) of the pieces of a straight move s(t) from 0 to 1.

    It speeds up with `s'' = a` for the time `ramp`, cruises, and slows down.
    """
    d = end - start
    top = a * ramp
    reached = a * ramp**2 / 2
    speeding = (ramp, np.stack([a / 2 * d, 0 * d, start]))
    cruising = (cruise, np.stack([0 * d, top * d, start + reached * d]))
    slowing = (ramp, np.stack([-a / 2 * d, top * d, end - reached * d]))
    return [speeding, cruising, slowing] if cruise > 0 else [speeding, slowing]


def _join_pieces(pieces: Sequence[tuple[float, Array]]) -> tuple[Array, Array]:
    """Return breaks (m + 1,) and coefficients (3, m, n) of pieces one after the other."""
    steps, coefficients = zip(*pieces, strict=True)
    return np.concatenate([[0.0], np.cumsum(steps)]), np.stack(coefficients, axis=1)


@dataclass(frozen=True)
class PointToPoint(Parametrisation):
    """Straight moves between `size` poses; each third of a move speeds up, cruises, slows down.

    `steps` are the times of the moves [s], equal if not given. A controller moves between the same
    poses faster (`PointToPointMotion.within`).
    """

    steps: tuple[float, ...] = ()
    key = "point-to-point"
    size_name = "poses"

    def _list_steps(self) -> Array:
        equal = np.full(self.size - 1, self.duration / (self.size - 1))
        return np.array(self.steps) if self.steps else equal

    def basis(self, t: Array, order: int) -> Array:
        """Return the derivative of this order of the basis functions."""
        return self.motion(np.eye(self.size)).derivative(t, order)

    def motion(self, coefficients: Array) -> Motion:
        """Return the moves at the given times."""
        pieces: list[tuple[float, Array]] = []
        for start, end, step in zip(
            coefficients[:-1], coefficients[1:], self._list_steps(), strict=True
        ):
            # Thirds: the acceleration is 4.5 of the mean, which is way over time squared.
            pieces += _shape_move(start, end, 4.5 / step**2, step / 3, step / 3)
        return PiecewisePolynomial(*_join_pieces(pieces))

    def retimed(self, steps: Array) -> PointToPoint:
        """Return the family with moves in proportion to `steps`, of the same duration."""
        scaled = np.asarray(steps) * self.duration / np.sum(steps)
        return replace(self, steps=tuple(float(step) for step in scaled))

    @property
    def shortest_wave(self) -> float:
        """Two moves [s]."""
        return 2 * float(self._list_steps().min())

    @property
    def constant(self) -> Array:
        """Coefficients of the constant 1: equal poses."""
        return np.ones(self.size)


PARAMETRISATIONS.register(PointToPoint.key, PointToPoint)


def pace_moves(
    poses: Array,
    bounds: MotionBounds,
    constraints: Sequence[StateConstraint],
    dwell: ArrayLike = 0.0,
) -> PointToPointMotion | None:
    """Return the motion through `poses` (m, n) whose moves are as fast as the limits allow.

    Returns None if a move is impossible.

    A move on which a constraint is violated even at rest, such as a collision or a weight that is
    too heavy, cannot be made at any speed.
    """
    pace = np.ones(len(poses) - 1)
    for k in range(len(pace)):
        if np.abs(poses[k + 1] - poses[k]).max() <= STANDSTILL:
            continue
        while not _holds(_make_motion(poses[k : k + 2], bounds, pace=pace[k]), constraints):
            if pace[k] == 1.0 and not _holds(
                _make_motion(poses[k : k + 2], bounds), constraints, at_rest=True
            ):
                return None
            pace[k] *= SLOWING
            if pace[k] < SLOWEST:
                return None
    whole = _make_motion(poses, bounds, dwell, pace)
    while not _holds(whole, constraints):
        pace *= SLOWING
        if pace.min() < SLOWEST * SLOWING:
            return None
        whole = _make_motion(poses, bounds, dwell, pace)
    return whole


def find_violations(constraints: Sequence[StateConstraint], q: Array, *rates: Array) -> Mask:
    """Return at which states (N,), at rest unless `rates` qd, qdd are given, one does not hold."""
    qd, qdd = rates or (np.zeros_like(q), np.zeros_like(q))
    over = np.zeros(len(q), dtype=bool)
    for constraint in constraints:
        values = constraint.values(q, qd, qdd)
        over |= (np.abs(values) if constraint.two_sided else values).max(axis=1) >= 1
    return over


def _make_motion(
    poses: Array, bounds: MotionBounds, dwell: ArrayLike = 0.0, pace: ArrayLike = 1.0
) -> PointToPointMotion:
    return PointToPointMotion.within(
        poses, velocity=bounds.velocity, acceleration=bounds.acceleration, dwell=dwell, pace=pace
    )


def _holds(
    motion: PointToPointMotion, constraints: Sequence[StateConstraint], *, at_rest: bool = False
) -> bool:
    state = motion.at(motion.sample_times(CHECK_RATE))
    return not np.any(find_violations(constraints, *state[: 1 if at_rest else 3]))
