"""The causes of the torque error of CAD, and the Shapley value that divides it among them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

from asbuilt.arrays import Array

Subset = frozenset[str]

CAUSES: dict[str, str] = {
    "offset": "torque offset",
    "friction": "viscous and Coulomb friction",
    "richer friction": "richer friction",
    "armature": "armature",
    "payload": "payload",
    "mounting": "base tilt",
    "gain": "torque gain",
    "links": "mass distribution of the links",
}
"""Names of the causes in text, in the order in which the nested models add them."""
BEFORE: dict[str, str] = {"richer friction": "friction", "links": "payload"}
"""A general cause comes after the special one that it contains in every order."""


def shapley_values(causes: tuple[str, ...], worth: Callable[[Subset], Array]) -> dict[str, Array]:
    """Divide worth(all) - worth(none), each (n,), by the mean of what a cause adds.

    The mean is over the orders that take `BEFORE[c]`, if present, before c (Faigle and Kern, 1992).

    >>> def worth(some):
    ...     return np.array([float("links" in some) or 0.5 * len(some)])
    >>> shapley_values(("payload", "links"), worth)
    {'payload': array([0.5]), 'links': array([0.5])}
    """
    ways_to, ways_from = _orders(causes)
    values = {some: worth(some) for some in ways_to}
    return {
        cause: np.asarray(
            sum(
                ways_to[some]
                * ways_from[some | {cause}]
                / ways_to[frozenset(causes)]
                * (values[some | {cause}] - values[some])
                for some in ways_to
                if cause not in some and some | {cause} in ways_to
            )
        )
        for cause in causes
    }


def _orders(causes: tuple[str, ...]) -> tuple[dict[Subset, int], dict[Subset, int]]:
    """Count, for every feasible set, the orders that lead to it from none and from it to all."""
    everything = frozenset(causes)
    feasible = [
        frozenset(some)
        for size in range(len(causes) + 1)
        for some in combinations(causes, size)
        if all(BEFORE.get(cause) not in everything or BEFORE[cause] in some for cause in some)
    ]
    ways_to: dict[Subset, int] = {frozenset(): 1}
    for some in feasible[1:]:
        ways_to[some] = sum(ways_to.get(some - {cause}, 0) for cause in some)
    ways_from: dict[Subset, int] = {everything: 1}
    for some in reversed(feasible[:-1]):
        ways_from[some] = sum(ways_from.get(some | {cause}, 0) for cause in everything - some)
    return ways_to, ways_from
