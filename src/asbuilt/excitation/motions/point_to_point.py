"""Point-to-point motion between poses, as controllers make it."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import STANDSTILL, limit_array, way_point_array
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial


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
        q = way_point_array(poses, "poses")
        n = q.shape[1]
        v_max, a_max = (
            limit_array(velocity, n, "velocity"),
            limit_array(acceleration, n, "acceleration"),
        )
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
        steps: list[float] = []
        pieces: list[np.ndarray] = []
        for k in range(q.shape[0] - 1):
            d = q[k + 1] - q[k]
            moving = np.abs(d) > STANDSTILL
            if np.any(moving):
                v = float(np.min(v_max[moving] / np.abs(d[moving]))) * paces[k]
                a = float(np.min(a_max[moving] / np.abs(d[moving]))) * paces[k] ** 2
                ramp = min(v / a, 1 / np.sqrt(a))
                cruise = max(1 / (a * ramp) - ramp, 0.0) if v * v < a else 0.0
                top = a * ramp
                reached = a * ramp**2 / 2
                steps.append(ramp)
                pieces.append(np.stack([a / 2 * d, 0 * d, q[k]]))
                if cruise > 0:
                    steps.append(cruise)
                    pieces.append(np.stack([0 * d, top * d, q[k] + reached * d]))
                steps.append(ramp)
                pieces.append(np.stack([-a / 2 * d, top * d, q[k + 1] - reached * d]))
            if k < dwells.size and dwells[k] > 0:
                steps.append(float(dwells[k]))
                pieces.append(np.stack([0 * d, 0 * d, q[k + 1]]))
        if not steps:
            raise MotionError("the poses are all the same and there is no dwell; nothing moves")
        return cls(np.concatenate([[0.0], np.cumsum(steps)]), np.stack(pieces, axis=1))
