"""Distances between many segments, and between segments and boxes, at once."""

# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from asbuilt.arrays import Array
from asbuilt.compilation import kernel, part

PARALLEL = 1e-12
"""Squared sine of the angle below which segments count as parallel, and squared length [m^2] below
which one is a point.
"""
GOLDEN = 0.6180339887498949
"""The golden section."""


def find_nearest_on_segments(
    start: Array, along: Array, other_start: Array, other_along: Array
) -> tuple[Array, Array]:
    """Return the nearest points (N, 3) of pairs of segments, all arguments (N, 3).

    The segments are `start + s along` and `other_start + t other_along`, s and t in 0 ... 1.

    Source: Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    between = start - other_start
    a = np.einsum("si,si->s", along, along)
    e = np.einsum("si,si->s", other_along, other_along)
    b, c, f = (
        np.einsum("si,si->s", *pair)
        for pair in ((along, other_along), (along, between), (other_along, between))
    )
    determinant = a * e - b * b
    skew = determinant > PARALLEL * np.maximum(a * e, PARALLEL)
    s = np.where(skew, np.clip((b * f - c * e) / np.where(skew, determinant, 1.0), 0.0, 1.0), 0.0)
    t = (b * s + f) / np.maximum(e, PARALLEL)
    beyond = (t < 0) | (t > 1) | (e <= PARALLEL)
    t = np.where(e <= PARALLEL, 0.0, np.clip(t, 0.0, 1.0))
    s = np.where(beyond, np.clip((b * t - c) / np.maximum(a, PARALLEL), 0.0, 1.0), s)
    s = np.where(a <= PARALLEL, 0.0, s)
    return start + s[:, None] * along, other_start + t[:, None] * other_along


def find_nearest_to_box(start: Array, along: Array, half: Array) -> tuple[Array, Array, Array]:
    """Return the nearest points, signed distances and outward normals of segments and a box.

    Segments (N, 3) are in the axes of the box of half extent `half` (3,).

    The signed distance to a convex body is convex along a line, so golden sections find its
    minimum.
    """
    points = np.empty((len(start), 3))
    distances = np.empty(len(start))
    normals = np.zeros((len(start), 3))
    _search_closest_points(
        np.ascontiguousarray(start),
        np.ascontiguousarray(along),
        np.array(half),
        points,
        distances,
        normals,
    )
    return points, distances, normals


@part
def _measure_signed_distance(x, y, z, half):
    a = abs(x) - half[0]
    b = abs(y) - half[1]
    c = abs(z) - half[2]
    deepest = max(a, b, c)
    if deepest <= 0.0:
        return deepest
    a = max(a, 0.0)
    b = max(b, 0.0)
    c = max(c, 0.0)
    return math.sqrt(a * a + b * b + c * c)


@kernel("f2 f2 f1 F2 F1 F2")
def _search_closest_points(start, along, half, points, distances, normals):
    for i in range(start.shape[0]):
        x = start[i, 0]
        y = start[i, 1]
        z = start[i, 2]
        dx = along[i, 0]
        dy = along[i, 1]
        dz = along[i, 2]
        low = 0.0
        high = 1.0
        inner = 1.0 - GOLDEN
        outer = GOLDEN
        at_inner = _measure_signed_distance(x + inner * dx, y + inner * dy, z + inner * dz, half)
        at_outer = _measure_signed_distance(x + outer * dx, y + outer * dy, z + outer * dz, half)
        # Golden sections, after which the place on a segment is known to 1e-9 of its length.
        for _ in range(44):
            if at_inner <= at_outer:
                high = outer
                outer = inner
                at_outer = at_inner
                inner = high - GOLDEN * (high - low)
                at_inner = _measure_signed_distance(
                    x + inner * dx, y + inner * dy, z + inner * dz, half
                )
            else:
                low = inner
                inner = outer
                at_inner = at_outer
                outer = low + GOLDEN * (high - low)
                at_outer = _measure_signed_distance(
                    x + outer * dx, y + outer * dy, z + outer * dz, half
                )
        s = (low + high) / 2
        for k in range(3):
            points[i, k] = start[i, k] + s * along[i, k]
        distances[i] = _measure_signed_distance(points[i, 0], points[i, 1], points[i, 2], half)
        for k in range(3):
            excess = abs(points[i, k]) - half[k]
            side = 1.0 if points[i, k] > 0 else -1.0
            if distances[i] > 0.0:
                normals[i, k] = side * max(excess, 0.0) / distances[i]
            elif excess == distances[i]:
                normals[i, k] = side
