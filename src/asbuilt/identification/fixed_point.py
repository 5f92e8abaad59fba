"""Extrapolation of iterations that converge to a fixed point by a constant factor each."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array

KEPT_STEPS = 5
"""Steps that are combined."""


class FixedPoint:
    """Extrapolate an iteration `x <- g(x)`.

    The step is the combination of the last ones whose changes `g(x) - x` cancel best (Anderson,
    J. ACM 12, 1965; Walker and Ni, SIAM J. Numerical Analysis 49, 2011); of one number, the secant.
    Far from the fixed point (a change above `near`), and after a change that grew, it is the plain
    one, so that the iteration stays with its own fixed point.

    >>> ahead, x = FixedPoint(), np.array([0.0])
    >>> for _ in range(3):
    ...     x = ahead.advance(x, 1.0 + 0.9 * x)
    >>> x.round(6).tolist()
    [10.0]
    """

    def __init__(self, near: float = np.inf) -> None:
        self._near = near
        self._changes: list[Array] = []
        self._images: list[Array] = []

    def advance(self, given: Array, image: Array) -> Array:
        """Return the values (n,) to try after those `given` became their `image`."""
        change = image - given
        size = float(np.max(np.abs(change), initial=0.0))
        if size > self._near or (self._changes and size > np.max(np.abs(self._changes[-1]))):
            self._changes = []
            self._images = []
        self._changes = [*self._changes[-KEPT_STEPS:], change]
        self._images = [*self._images[-KEPT_STEPS:], image]
        if len(self._changes) < 2:
            return image
        share = np.linalg.lstsq(np.diff(self._changes, axis=0).T, change, rcond=None)[0]
        return np.asarray(image - np.diff(self._images, axis=0).T @ share)
