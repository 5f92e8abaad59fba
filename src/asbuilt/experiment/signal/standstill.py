"""When a joint stands still: its friction then has no sign, and the sign of its velocity is noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array, Mask

SLOW = 0.003
"""Share of a joint's top speed below which it may be standing."""
SLOWEST = 0.0015
"""The same as a share of the fastest joint's top speed, for joints that hardly move at all."""
PAUSE = 0.5
"""How long [s] a joint must be slow to be standing, and all joints must stand to be left out.

A reversal is over sooner.
"""


def standstill_speeds(velocities: Sequence[Array]) -> tuple[float, ...]:
    """Return the speed of each joint below which it may be standing, from the velocities (L, n) of
    all runs.
    """
    top = np.max([np.quantile(np.abs(qd), 0.99, axis=0) for qd in velocities], axis=0)
    return tuple(np.maximum(SLOW * top, SLOWEST * top.max()).tolist())


def standing(qd: Array, speeds: Sequence[float], rate: float) -> Mask:
    """Return where each joint stands still, (L, n): slower than its speed for `PAUSE` or longer."""
    slow = np.abs(qd) < np.asarray(speeds)
    return np.column_stack([_lasting(slow[:, k], PAUSE * rate) for k in range(qd.shape[1])])


def moving_ranges(still: Mask, rate: float, shoulder: int) -> list[tuple[int, int]]:
    """Return the index ranges that are left of (L, n) when rests of all joints are cut out but for
    `shoulder` samples next to motion.

    Within a rest friction takes any value up to the Coulomb torque, so its samples say little about
    a model in which friction follows the velocity.
    """
    rest = _lasting(np.asarray(still.all(axis=1)), PAUSE * rate)
    keep = ~rest
    for a, b in _runs(rest):
        keep[a : a + shoulder if a > 0 else a] = True
        keep[max(b - shoulder, a) if b < rest.size else b : b] = True
    return _runs(keep)


def _lasting(mask: Mask, samples: float) -> Mask:
    lasting = np.zeros_like(mask)
    for a, b in _runs(mask):
        lasting[a:b] = b - a >= samples
    return lasting


def _runs(mask: Mask) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
