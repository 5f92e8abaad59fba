"""Search for a decisively better order of columns, by any cost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import combinations
from typing import TypeVar

T = TypeVar("T")


def decisive_change(
    logged: T, changes: Iterable[T], cost: Callable[[T], float], fall: float
) -> T | None:
    """Return the cheapest of `changes` if it costs less than `logged` by more than `fall`.

    Parameters
    ----------
    logged
        Order of columns as logged.
    changes
        Other orders, such as those of `swaps`.
    cost
        Misfit of an order.
    fall
        Difference of the costs from which the change is decisive.
    """
    costs = [(cost(change), change) for change in changes]
    best = min(costs, key=lambda pair: pair[0], default=None)
    return best[1] if best is not None and best[0] < cost(logged) - fall else None


def swaps(order: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield the orders with two entries swapped.

    >>> list(swaps((0, 1, 2)))
    [(1, 0, 2), (2, 1, 0), (0, 2, 1)]
    """
    for i, j in combinations(range(len(order)), 2):
        changed = list(order)
        changed[i], changed[j] = order[j], order[i]
        yield tuple(changed)
