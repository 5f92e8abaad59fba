"""Moves between poses, as fast as limits and constraints allow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import STANDSTILL
from asbuilt.excitation.motions.point_to_point import PointToPointMotion
from asbuilt.excitation.state_constraint import StateConstraint

CHECK_RATE = 1000.0
"""Rate of the grid on which a motion must keep its constraints [Hz]."""

SLOWING, SLOWEST = 0.93, 0.1
"""By what factor a move is slowed at a time, and at which share of its speed that is given up."""


def paced_moves(
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
        while not _holds(_motion(poses[k : k + 2], bounds, pace=pace[k]), constraints):
            if pace[k] == 1.0 and not _holds(
                _motion(poses[k : k + 2], bounds), constraints, at_rest=True
            ):
                return None
            pace[k] *= SLOWING
            if pace[k] < SLOWEST:
                return None
    whole = _motion(poses, bounds, dwell, pace)
    while not _holds(whole, constraints):
        pace *= SLOWING
        if pace.min() < SLOWEST * SLOWING:
            return None
        whole = _motion(poses, bounds, dwell, pace)
    return whole


def violated(
    constraints: Sequence[StateConstraint], q: Array, qd: Array, qdd: Array
) -> NDArray[np.bool_]:
    """Return at which states (N,) a constraint does not hold."""
    over = np.zeros(len(q), dtype=bool)
    for constraint in constraints:
        values = constraint.values(q, qd, qdd)
        over |= (np.abs(values) if constraint.two_sided else values).max(axis=1) >= 1
    return over


def _motion(
    poses: Array, bounds: MotionBounds, dwell: ArrayLike = 0.0, pace: ArrayLike = 1.0
) -> PointToPointMotion:
    return PointToPointMotion.within(
        poses, velocity=bounds.velocity, acceleration=bounds.acceleration, dwell=dwell, pace=pace
    )


def _holds(
    motion: PointToPointMotion, constraints: Sequence[StateConstraint], *, at_rest: bool = False
) -> bool:
    q, qd, qdd = motion.at(motion.sample_times(CHECK_RATE))
    rest = np.zeros_like(q)
    return not np.any(
        violated(constraints, q, rest, rest) if at_rest else violated(constraints, q, qd, qdd)
    )
