"""Motions one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import QUANTITIES, TIME_TOLERANCE, Motion

JOIN_TOLERANCE = 1e-9
"""Largest jump of position and velocity between two motions that are joined, in rad, m and their
rates.
"""


class Concatenated(Motion):
    """Run motions one after the other, with rests of `dwell` seconds (one, or one per gap).

    At the instant where two motions meet, the later one is evaluated.

    Raises
    ------
    MotionError
        If the end of a motion is not the start of the next, in position and velocity, or a dwell
        starts while a joint moves.

    Examples
    --------
    >>> from asbuilt.excitation.motions.quintic import QuinticMotion
    >>> there = QuinticMotion.between([0.0], [1.0], duration=2.0)
    >>> back = QuinticMotion.between([1.0], [0.0], duration=2.0)
    >>> Concatenated([there, back], dwell=0.5).duration
    4.5
    """

    parametrisation = "concatenated"

    def __init__(self, motions: Sequence[Motion], dwell: ArrayLike = 0.0) -> None:
        if not motions:
            raise MotionError("there is no motion to concatenate; give at least one")
        dwells = np.broadcast_to(np.asarray(dwell, dtype=np.float64), (len(motions) - 1,))
        if np.any(dwells < 0) or not np.all(np.isfinite(dwells)):
            raise MotionError(f"dwell times must be finite and not negative, got {dwells.tolist()}")
        for k, (earlier, later) in enumerate(pairwise(motions)):
            _check_join(k, earlier, later, float(dwells[k]))
        self.motions = tuple(motions)
        durations = np.array([motion.duration for motion in motions])
        self.starts = read_only(np.concatenate([[0.0], np.cumsum(durations[:-1] + dwells)]))
        self._ends = self.starts + durations

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return float(self._ends[-1])

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.motions[0].n_joints

    def _evaluate(self, t: Array, order: int) -> Array:
        values = np.zeros((t.size, self.n_joints))
        which = np.searchsorted(self.starts, t, side="right") - 1
        for k, motion in enumerate(self.motions):
            rows = np.flatnonzero(which == k)
            local = t[rows] - self.starts[k]
            resting = local > motion.duration * (1 + TIME_TOLERANCE)
            values[rows[~resting]] = motion.derivative(local[~resting], order)
            if order == 0:
                values[rows[resting]] = motion.end
        return values

    def extremes(self, order: int) -> tuple[Array, Array]:
        """Return the smallest and the largest value of a derivative, two (n,)."""
        found = [motion.extremes(order) for motion in self.motions]
        return np.min([low for low, _ in found], axis=0), np.max(
            [high for _, high in found], axis=0
        )


def _check_join(k: int, earlier: Motion, later: Motion, dwell: float) -> None:
    if earlier.n_joints != later.n_joints:
        raise MotionError(
            f"motion {k + 1} moves {earlier.n_joints} joints, motion {k + 2} moves"
            f" {later.n_joints}; they cannot follow each other"
        )
    for order in (0, 1):
        before, after = earlier.derivative(earlier.duration, order), later.derivative(0.0, order)
        jump = np.abs(after - before)
        j = int(np.argmax(jump))
        if jump[j] > JOIN_TOLERANCE:
            raise MotionError(
                f"motion {k + 1} ends with {QUANTITIES[order]} {before[j]:g} of joint {j + 1},"
                f" motion {k + 2} starts with {after[j]:g}; put a QuinticMotion.between the two"
            )
        if order == 1 and dwell > 0 and np.max(np.abs(before)) > JOIN_TOLERANCE:
            raise MotionError(
                f"motion {k + 1} is still moving when a dwell of {dwell:g} s starts; end it at rest"
                " or set the dwell to 0"
            )
