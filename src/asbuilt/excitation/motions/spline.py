"""Cubic and quintic splines through way points, at given times or as fast as the limits allow."""

from __future__ import annotations

from math import factorial
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import check_limits_of_pace, check_way_points
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial

Ends = Literal["rest", "clamped", "natural"]

_END_DERIVATIVES: dict[tuple[int, str], tuple[int, ...]] = {
    (3, "rest"): (1, 2),
    (3, "clamped"): (1,),
    (3, "natural"): (2,),
    (5, "rest"): (1, 2),
    (5, "natural"): (3, 4),
}
"""Which derivatives vanish at both ends, by degree and kind of end."""

SHARPNESS = 30.0
"""Exponent of the norm that approximates the maximum while times are improved."""


class SplineMotion(PiecewisePolynomial):
    """Move along a spline through way points.

    Build it with `through` (given times) or `within` (given limits).
    """

    parametrisation = "spline"

    @classmethod
    def through(
        cls, way_points: ArrayLike, times: ArrayLike, *, degree: int = 5, ends: Ends = "rest"
    ) -> Self:
        """Pass `way_points` (m, n) at `times` (m,), which start at 0, with degree 3 or 5.

        `ends` says what vanishes at both ends: velocity and acceleration ("rest"), velocity
        ("clamped", degree 3 only), or the derivatives that make the curve smoothest ("natural":
        acceleration for degree 3; third and fourth derivative for degree 5). A cubic at rest has
        two more knots, in the middle of the first and the last interval (Biagiotti & Melchiorri
        2008, section 4.4.3).

        Raises
        ------
        MotionError
            If the times do not rise, shapes do not agree, or degree and ends do not go together.

        Examples
        --------
        >>> motion = SplineMotion.through([[0.0], [1.0], [0.5]], [0.0, 1.0, 2.0])
        >>> [abs(x).max().round(9).item() for x in motion.at([0.0, 2.0])[1:]]
        [0.0, 0.0]
        """
        q = check_way_points(way_points)
        t = np.asarray(times, dtype=np.float64)
        if t.shape != (q.shape[0],) or not np.all(np.diff(t) > 0) or not np.all(np.isfinite(t)):
            raise MotionError(
                f"{q.shape[0]} way points need as many rising times, got"
                f" {np.array2string(t, threshold=8)}"
            )
        vanishing = _END_DERIVATIVES.get((degree, ends))
        if vanishing is None:
            known = ", ".join(f"degree {d} {e!r}" for d, e in _END_DERIVATIVES)
            raise MotionError(
                f"there is no spline of degree {degree} with ends {ends!r}; choose from {known}"
            )
        if degree == 5 and ends == "natural" and t.size < 3:
            raise MotionError(
                "a natural quintic spline needs at least 3 way points; give more, or ends='rest'"
            )
        knots = t - t[0]
        if degree == 3 and ends == "rest":
            knots = np.insert(
                knots, [1, knots.size - 1], [knots[1] / 2, (knots[-2] + knots[-1]) / 2]
            )
            knots = np.unique(knots) if t.size > 2 else np.linspace(0.0, knots[-1], 4)
        padded = np.concatenate([np.zeros(degree), knots, np.full(degree, knots[-1])])
        zeros: Any = [(order, np.zeros(q.shape[1])) for order in vanishing]
        curve = make_interp_spline(t - t[0], q, k=degree, t=padded, bc_type=(zeros, zeros))
        return cls(
            knots, np.stack([curve(knots[:-1], nu=k) / factorial(k) for k in range(degree, -1, -1)])
        )

    @classmethod
    def within(
        cls,
        way_points: ArrayLike,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        jerk: ArrayLike = np.inf,
        degree: int = 5,
        ends: Ends = "rest",
    ) -> Self:
        """Pass `way_points` (m, n) in a short time within the limits, one number or one per joint.

        The times between way points start from the limits of each step alone and are improved by a
        quasi-Newton method (L-BFGS) on a smooth stand-in for the duration; then the whole is scaled
        so that one limit is reached exactly, since velocity falls with the scale of time,
        acceleration with its square and jerk with its cube. The shorter of the two is returned; it
        is not proven optimal.
        """
        q = check_way_points(way_points)
        limits = check_limits_of_pace(q.shape[1], velocity, acceleration, jerk, "spline")
        d = np.abs(np.diff(q, axis=0))
        steps = np.max(
            [np.power(d / limit, 1 / k) for k, limit in enumerate(limits, start=1)], axis=(0, 2)
        )
        if not np.any(steps > 0):
            raise MotionError("the way points are all the same; nothing moves")
        steps = np.maximum(steps, 1e-2 * steps.max())

        def times(logs: Array) -> Array:
            return np.concatenate([[0.0], np.cumsum(np.exp(logs))])

        def factors(logs: Array) -> Array:
            return _find_time_factors(cls.through(q, times(logs), degree=degree, ends=ends), limits)

        def smooth_duration(logs: Array) -> float:
            return float(
                np.log(np.exp(logs).sum()) + np.log(np.sum(factors(logs) ** SHARPNESS)) / SHARPNESS
            )

        start = np.log(steps)
        bounds = list(zip(start - np.log(4), start + np.log(4), strict=True))
        # Most iterations of that improvement.
        found = minimize(
            smooth_duration,
            start,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 40},
        ).x
        scaled = [times(logs) * factors(logs).max() for logs in (start, found)]
        return cls.through(q, min(scaled, key=lambda t: float(t[-1])), degree=degree, ends=ends)


def _find_time_factors(motion: PiecewisePolynomial, limits: list[Array]) -> Array:
    """Return the factor of time that each limit needs in each piece and joint, flat.

    The `limits` bound velocity, acceleration and jerk.
    """
    needed = []
    for order, limit in enumerate(limits, start=1):
        if np.any(np.isfinite(limit)):
            low, high = motion.extremes_per_piece(order)
            needed.append(np.power(np.maximum(-low, high).clip(min=0.0) / limit, 1 / order).ravel())
    return np.concatenate(needed)
