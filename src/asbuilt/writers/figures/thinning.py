"""Thinning of long curves without losing a peak."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.validation.residuals import find_contiguous_segments


def thin_curves(t: Array, *curves: Array, points: int) -> tuple[Array, ...]:
    """Return `t` (M,) and each curve (M,) thinned to about `points`.

    Every bucket of time keeps the samples where any curve is smallest and largest, and each
    contiguous segment its ends; NaN between segments keeps lines from bridging gaps.
    """
    share = points / max(len(t), 1)
    kept = list[list[Array]]()
    for start, stop in find_contiguous_segments(t):
        index = start + _find_extremes(
            [curve[start:stop] for curve in curves], max(2, int(share * (stop - start)))
        )
        kept.append([np.append(curve[index], np.nan) for curve in (t, *curves)])
    if not kept:
        return t, *curves
    # No gap behind the last segment.
    return tuple(np.concatenate(parts)[:-1] for parts in zip(*kept, strict=True))


def _find_extremes(curves: list[Array], points: int) -> Indices:
    """Return the indices of the bucket-wise extremes of every curve, and of both ends."""
    n = len(curves[0])
    if n <= points:
        return np.arange(n)
    width = max(1, -(-2 * len(curves) * n // points))
    whole = n // width * width
    chosen: list[Indices] = [np.array([0, n - 1])]
    offsets = np.arange(0, whole, width)
    for curve in curves:
        buckets = curve[:whole].reshape(-1, width)
        chosen += [offsets + buckets.argmin(axis=1), offsets + buckets.argmax(axis=1)]
        if whole < n:
            chosen.append(whole + np.array([curve[whole:].argmin(), curve[whole:].argmax()]))
    return np.unique(np.concatenate(chosen))
