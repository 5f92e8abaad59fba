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


def find_true_ranges(mask: Mask) -> list[tuple[int, int]]:
    """Return the half-open index ranges of a mask (N,) in which all values are true.

    >>> find_true_ranges(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
