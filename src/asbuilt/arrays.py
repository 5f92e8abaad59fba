"""Array types; every array is `(n_samples, n_joints)` unless stated."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]


def read_only(values: ArrayLike) -> Array:
    """Return a read-only float64 copy."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def find_true_rows(mask: Mask) -> Mask:
    """Return which rows of (N, m) hold a true value; by columns, as rows are short."""
    found: Mask = np.any(np.ascontiguousarray(mask.T), axis=0)
    return found


def find_finite_rows(*channels: Array | None) -> Mask:
    """Return in which rows all channels (N,) or (N, m) are finite; None is no channel.

    >>> find_finite_rows(np.array([0.0, np.nan, 1.0]), np.array([[1.0], [1.0], [np.inf]])).tolist()
    [True, False, False]
    """
    known = [np.atleast_2d(channel.T).T for channel in channels if channel is not None]
    lacking = [find_true_rows(~np.isfinite(channel)) for channel in known]
    return ~np.asarray(np.logical_or.reduce(lacking))


def find_true_ranges(mask: Mask) -> list[tuple[int, int]]:
    """Return the half-open index ranges of a mask (N,) in which all values are true.

    >>> find_true_ranges(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
