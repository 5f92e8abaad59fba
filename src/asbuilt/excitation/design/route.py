"""Route between static poses avoiding collisions."""

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
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.point_to_point import (
    PointToPointMotion,
    find_violations,
    pace_moves,
)
from asbuilt.excitation.state_constraint import StateConstraint

NODES = 1000
NEIGHBOURS = 12
"""Most poses of a roadmap, and neighbours to which each is connected."""

AT_ONCE = 4096
"""Poses evaluated together, for memory."""


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Connected poses (M, n): straight segments in joint space along `edges` (E, 2) are free.

    Source: Kavraki et al. (1996).
    """

    nodes: Array
    edges: NDArray[np.int64]

    @classmethod
    def of(
        cls, poses: Array, bounds: MotionBounds, obstacles: Sequence[StateConstraint]
    ) -> Roadmap:
        """Return the largest connected component of the poses."""
        nodes = poses[:NODES]
        # The nearest node of each is itself.
        near = np.argsort(_measure_distances(nodes, nodes, bounds), axis=1)[:, 1 : NEIGHBOURS + 1]
        # Each pair once, whichever of the two has the other as a neighbour.
        pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})
        edges = _select_free_segments(nodes, pairs, obstacles)
        parts = connected_components(
            _build_graph(edges, np.ones(len(edges)), len(nodes)), directed=False
        )[1]
        # Poses in smaller components could not be reached.
        kept = parts == np.argmax(np.bincount(parts))
        # New numbers of the nodes that are kept.
        number = np.cumsum(kept) - 1
        return cls(nodes[kept], number[edges[kept[edges].all(axis=1)]])


def plan_route(
    poses: Array,
    roadmap: Roadmap | None,
    bounds: MotionBounds,
    obstacles: Sequence[StateConstraint],
    loads: Sequence[StateConstraint],
    dwell: float,
) -> tuple[Array, PointToPointMotion, int]:
    """Return all `poses` (K, n) in the order of a short route, its motion, and its turning poses.

    Segments are straight in joint space if the values of `obstacles` stay below 1, else they follow
    the roadmap; without one, obstacles are not checked. The velocity is at the bounds, or less
    on segments whose torque exceeds `loads`; `dwell` is the rest at each pose [s].

    Raises
    ------
    MotionError
        If no route is found, or the torque is too high at any speed.
    """
    nodes = poses
    apart = _measure_distances(poses, poses, bounds)
    route = find_short_tour(apart)
    if roadmap is not None:
        blocked = np.zeros(apart.shape, dtype=bool)
        pairs = np.argwhere(np.triu(~blocked, 1))
        blocked[tuple(pairs.T)] = ~segments_free(poses, pairs.tolist(), obstacles)
        blocked |= blocked.T
        # Blocked segments are expensive, not forbidden: a tour without them may not exist.
        route = find_short_tour(np.where(blocked, apart + 1e3 * (1 + apart.max()), apart))
        # A tour around the obstacles may need no turning pose at all.
        if any(blocked[i, j] for i, j in pairwise(route)):
            nodes = np.vstack([poses, roadmap.nodes])
            lengths, before = _find_shortest_routes(
                nodes, poses, roadmap, blocked, bounds, obstacles
            )
            if not np.all(np.isfinite(lengths)):
                i, j = np.argwhere(~np.isfinite(lengths))[0]
                raise MotionError(
                    f"no route without collision was found from {np.round(poses[i], 2).tolist()}"
                    f" to {np.round(poses[j], 2).tolist()}; use fewer poses, another seed, or a"
                    " smaller clearance"
                )
            # The tour is chosen again: routes around obstacles are longer than lines.
            route = _insert_turns(find_short_tour(lengths), before)
    # Poses are visited once for a reading; passing through again is no stop.
    first = [node < len(poses) and node not in route[:place] for place, node in enumerate(route)]
    motion = pace_moves(
        nodes[route], bounds, [*obstacles, *loads], np.where(first, dwell, 0.0)[1:-1]
    )
    if motion is None:
        raise MotionError(
            "the route between the poses exceeds the torque limits at any speed; allow more of the"
            " torque, or use another seed"
        )
    return nodes[route][first], motion, len(route) - len(poses)


def find_short_tour(apart: Array) -> list[int]:
    """Return an order in which the sum of the distances (K, K) is short; any end may come first.

    Nearest neighbour from every start, improved by reversing segments (2-opt; Croes 1958).
    """
    tours = []
    for start in range(len(apart)):
        order = [start]
        left = set(range(len(apart))) - {start}
        while left:
            nearest = min(left, key=lambda k: float(apart[order[-1], k]))
            order.append(nearest)
            left.remove(nearest)
        tours.append(_untangle(order, apart))
    # From every start: nearest neighbour depends on it most.
    return min(tours, key=lambda order: float(apart[order[:-1], order[1:]].sum()))


def _untangle(order: list[int], apart: Array) -> list[int]:
    improved = True
    while improved:
        improved = False
        for i in range(len(order) - 1):
            for j in range(i + 1, len(order)):
                # The tour is open: its ends have no neighbour.
                before = (apart[order[i - 1], order[i]] if i else 0.0) + (
                    apart[order[j], order[j + 1]] if j + 1 < len(order) else 0.0
                )
                after = (apart[order[i - 1], order[j]] if i else 0.0) + (
                    apart[order[i], order[j + 1]] if j + 1 < len(order) else 0.0
                )
                # Rounding would reverse a segment back and forth.
                if after < before - 1e-12:
                    order[i : j + 1] = reversed(order[i : j + 1])
                    improved = True
    return order


def _measure_distances(first: Array, second: Array, bounds: MotionBounds) -> Array:
    """Return the time that the slowest joint takes at its velocity limit (K, M) [s]."""
    return np.asarray(np.abs((first[:, None] - second[None]) / bounds.velocity).max(axis=2))


def segments_free(
    nodes: Array, pairs: Sequence[Sequence[int]], obstacles: Sequence[StateConstraint]
) -> NDArray[np.bool_]:
    """Return whether the straight segment between each pair of nodes is free of collisions."""
    # Largest move of a joint between poses that are checked along a segment [rad or m].
    # At least both ends.
    counts = [2 + int(np.abs(nodes[i] - nodes[j]).max() / 0.01) for i, j in pairs]
    places = np.vstack(
        [
            nodes[i] + np.linspace(0, 1, count)[:, None] * (nodes[j] - nodes[i])
            for (i, j), count in zip(pairs, counts, strict=True)
        ]
    )
    # Segments are joined into few calls, and cut apart again by their counts.
    over = [
        find_violations(obstacles, places[start : start + AT_ONCE])
        for start in range(0, len(places), AT_ONCE)
    ]
    return ~np.logical_or.reduceat(np.concatenate(over), np.cumsum([0, *counts[:-1]]))


def _select_free_segments(
    nodes: Array, pairs: Sequence[Sequence[int]], obstacles: Sequence[StateConstraint]
) -> NDArray[np.int64]:
    """Return the pairs of nodes (E, 2) whose segment is free."""
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)[segments_free(nodes, pairs, obstacles)]


def _find_shortest_routes(
    nodes: Array,
    poses: Array,
    roadmap: Roadmap,
    blocked: NDArray[np.bool_],
    bounds: MotionBounds,
    obstacles: Sequence[StateConstraint],
) -> tuple[Array, NDArray[np.int32]]:
    """Return the lengths of the shortest routes between the poses, and predecessors on them."""
    count = len(poses)
    # Nodes of the roadmap follow the poses.
    near = (
        np.argsort(_measure_distances(poses, roadmap.nodes, bounds), axis=1)[:, :NEIGHBOURS] + count
    )
    pairs = [(i, j) for i, row in enumerate(near.tolist()) for j in row]
    direct = np.argwhere(np.tril(~blocked, -1))
    ends = np.vstack(
        [
            _select_free_segments(nodes, pairs, obstacles),
            direct,
            roadmap.edges + count,
        ]
    )
    weights = np.abs((nodes[ends[:, 0]] - nodes[ends[:, 1]]) / bounds.velocity).max(axis=1)
    lengths, before = dijkstra(
        _build_graph(ends, weights, len(nodes)),
        directed=False,
        indices=np.arange(count),
        # Predecessors are kept from each pose, so that the turns on the way are known.
        return_predecessors=True,
    )
    return np.asarray(lengths[:, :count]), np.asarray(before)


def _build_graph(edges: NDArray[np.int64], weights: Array, count: int) -> csr_array[np.float64]:
    return csr_array((weights, (edges[:, 0], edges[:, 1])), shape=(count, count))


def _insert_turns(tour: Sequence[int], before: NDArray[np.int32]) -> list[int]:
    """Return the tour with the nodes between its poses."""
    route = [tour[0]]
    for start, stop in pairwise(tour):
        between = [stop]
        # Back along the predecessors, then turned round.
        while before[start, between[-1]] != start:
            between.append(int(before[start, between[-1]]))
        route += between[::-1]
    return route
