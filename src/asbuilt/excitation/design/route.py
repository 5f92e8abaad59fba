"""The way through standing poses: a short order, round what is in the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.design.interior_point import StateConstraint
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.pacing import paced_moves, violated
from asbuilt.excitation.motions.point_to_point import PointToPointMotion

STRIDE = 0.01
"""Largest move of a joint between poses that are looked at on the way [rad or m]."""

STATIONS, NEIGHBOURS = 1000, 12
"""Poses of a roadmap at most, and to how many others the way from each is looked at."""

AT_ONCE = 4096
"""Poses that are looked at together, for memory."""


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Hold poses (M, n) of which each can be reached from each other, straight in joint space along
    `edges` (E, 2) (Kavraki et al. 1996).
    """

    stations: Array
    edges: NDArray[np.int64]

    @classmethod
    def of(
        cls, poses: Array, bounds: MotionBounds, obstacles: Sequence[StateConstraint]
    ) -> Roadmap:
        """Return the largest part of the poses within which each can be reached from each other."""
        nodes = poses[:STATIONS]
        near = np.argsort(_distances(nodes, nodes, bounds), axis=1)[:, 1 : NEIGHBOURS + 1]
        pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})
        found = [
            pair
            for pair, clear in zip(pairs, ways_clear(nodes, pairs, obstacles), strict=True)
            if clear
        ]
        edges = np.array(found, dtype=np.int64).reshape(-1, 2)
        parts = connected_components(
            _graph(edges, np.ones(len(edges)), len(nodes)), directed=False
        )[1]
        kept = parts == np.argmax(np.bincount(parts))
        number = np.cumsum(kept) - 1
        return cls(nodes[kept], number[edges[kept[edges].all(axis=1)]])


@dataclass(frozen=True, eq=False)
class Travel:
    """Poses in the order in which they are visited, the motion through them, and at how many
    further poses it turns to get round something.
    """

    poses: Array
    motion: PointToPointMotion
    turns: int


def travel_through(
    poses: Array,
    roadmap: Roadmap | None,
    bounds: MotionBounds,
    obstacles: Sequence[StateConstraint],
    loads: Sequence[StateConstraint],
    dwell: float,
) -> Travel:
    """Return a short way through all `poses` (K, n), straight in joint space where the values of
    `obstacles` stay below 1, else over the roadmap.

    Without a roadmap obstacles are not looked for. The velocity is that of the bounds, or less on
    moves where `loads` (limits of torque) ask for it; `dwell` is the rest at each pose [s].

    Raises
    ------
    MotionError
        If no way is found, or the loads are too high however slow.
    """
    nodes, apart = poses, _distances(poses, poses, bounds)
    way = short_tour(apart)
    if roadmap is not None:
        pairs = [(i, j) for i in range(len(poses)) for j in range(i)]
        blocked = np.zeros(apart.shape, dtype=bool)
        blocked[tuple(np.transpose(pairs))] = ~ways_clear(poses, pairs, obstacles)
        blocked |= blocked.T
        way = short_tour(np.where(blocked, apart + 1e3 * (1 + apart.max()), apart))
        if any(blocked[i, j] for i, j in pairwise(way)):
            nodes = np.vstack([poses, roadmap.stations])
            lengths, before = _lengths(nodes, poses, roadmap, blocked, bounds, obstacles)
            if not np.all(np.isfinite(lengths)):
                i, j = np.argwhere(~np.isfinite(lengths))[0]
                raise MotionError(
                    "no way clear of obstacles was found between the poses"
                    f" {np.round(poses[i], 2).tolist()} and {np.round(poses[j], 2).tolist()}; ask"
                    " for fewer poses, give another seed, or allow more room"
                )
            way = _with_turns(short_tour(lengths), before)
    first = [node < len(poses) and node not in way[:place] for place, node in enumerate(way)]
    motion = paced_moves(
        nodes[way], bounds, [*obstacles, *loads], np.where(first, dwell, 0.0)[1:-1]
    )
    if motion is None:
        raise MotionError(
            "a way between the poses asks for too much torque, however slow; allow more of the"
            " torque, or give another seed"
        )
    return Travel(nodes[way][first], motion, len(way) - len(poses))


def short_tour(apart: Array) -> list[int]:
    """Return an order in which the sum of the distances (K, K) is short.

    Open, any end may come first.

    Nearest neighbour from every start, improved by reversing stretches (2-opt; Croes 1958).
    """
    tours = []
    for start in range(len(apart)):
        order, left = [start], set(range(len(apart))) - {start}
        while left:
            nearest = min(left, key=lambda k: float(apart[order[-1], k]))
            order.append(nearest)
            left.remove(nearest)
        tours.append(_untangled(order, apart))
    return min(tours, key=lambda order: float(apart[order[:-1], order[1:]].sum()))


def _untangled(order: list[int], apart: Array) -> list[int]:
    improved = True
    while improved:
        improved = False
        for i in range(len(order) - 1):
            for j in range(i + 1, len(order)):
                before = (apart[order[i - 1], order[i]] if i else 0.0) + (
                    apart[order[j], order[j + 1]] if j + 1 < len(order) else 0.0
                )
                after = (apart[order[i - 1], order[j]] if i else 0.0) + (
                    apart[order[i], order[j + 1]] if j + 1 < len(order) else 0.0
                )
                if after < before - 1e-12:
                    order[i : j + 1] = reversed(order[i : j + 1])
                    improved = True
    return order


def _distances(first: Array, second: Array, bounds: MotionBounds) -> Array:
    """Return how long the slowest joint takes at full velocity (K, M) [s]."""
    apart: Array = np.abs((first[:, None] - second[None]) / bounds.velocity).max(axis=2)
    return apart


def ways_clear(
    nodes: Array, pairs: Sequence[tuple[int, int]], obstacles: Sequence[StateConstraint]
) -> NDArray[np.bool_]:
    """Return whether the straight way between each pair of nodes is clear."""
    counts = [2 + int(np.abs(nodes[i] - nodes[j]).max() / STRIDE) for i, j in pairs]
    places = np.vstack(
        [
            nodes[i] + np.linspace(0, 1, count)[:, None] * (nodes[j] - nodes[i])
            for (i, j), count in zip(pairs, counts, strict=True)
        ]
    )
    over = []
    for start in range(0, len(places), AT_ONCE):
        part = places[start : start + AT_ONCE]
        over.append(violated(obstacles, part, np.zeros_like(part), np.zeros_like(part)))
    return ~np.logical_or.reduceat(np.concatenate(over), np.cumsum([0, *counts[:-1]]))


def _lengths(
    nodes: Array,
    poses: Array,
    roadmap: Roadmap,
    blocked: NDArray[np.bool_],
    bounds: MotionBounds,
    obstacles: Sequence[StateConstraint],
) -> tuple[Array, NDArray[np.int32]]:
    """Return the lengths of the shortest ways between the poses, and for each of these the node
    before any other on the way to it.
    """
    count = len(poses)
    near = np.argsort(_distances(poses, roadmap.stations, bounds), axis=1)[:, :NEIGHBOURS] + count
    pairs = [(i, j) for i, row in enumerate(near.tolist()) for j in row]
    edges = [
        pair
        for pair, clear in zip(pairs, ways_clear(nodes, pairs, obstacles), strict=True)
        if clear
    ]
    edges += [(i, j) for i in range(count) for j in range(i) if not blocked[i, j]]
    ends = np.vstack([np.array(edges, dtype=np.int64).reshape(-1, 2), roadmap.edges + count])
    weights = np.abs((nodes[ends[:, 0]] - nodes[ends[:, 1]]) / bounds.velocity).max(axis=1)
    lengths, before = dijkstra(
        _graph(ends, weights, len(nodes)),
        directed=False,
        indices=np.arange(count),
        return_predecessors=True,
    )
    return np.asarray(lengths[:, :count]), np.asarray(before)


def _graph(edges: NDArray[np.int64], weights: Array, count: int) -> csr_array[np.float64]:
    return csr_array((weights, (edges[:, 0], edges[:, 1])), shape=(count, count))


def _with_turns(tour: Sequence[int], before: NDArray[np.int32]) -> list[int]:
    """Return the tour with the nodes between its poses."""
    way = [tour[0]]
    for start, stop in pairwise(tour):
        between = [stop]
        while before[start, between[-1]] != start:
            between.append(int(before[start, between[-1]]))
        way += between[::-1]
    return way
