"""Joints at rest: their friction has no sign, and the sign of their velocity is noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array, Mask, find_true_ranges
from asbuilt.compilation import kernel

SLOWEST = 0.0015
"""Share of the fastest joint's top speed below which any joint may be at rest, but for `MOVING`."""
MOVING = 0.006
"""Share of its own top speed beyond which a joint moves, however slow compared with others: a
finger in m/s among joints in rad/s."""
PAUSE = 0.5
"""Least duration [s] of a rest; a reversal is shorter."""


def estimate_standstill_speeds(
    motions: Sequence[tuple[Array, Array]], cutoff: float
) -> tuple[float, ...]:
    """Return the speed of each joint below which it may be at rest.

    `motions` are positions and velocities (L, n) of segments, behind a low-pass of `cutoff` [Hz].
    """
    # 99 %: single samples of noise are no speed.
    top = np.max([np.quantile(np.abs(qd), 0.99, axis=0) for _, qd in motions], axis=0)
    swept = np.max([np.ptp(q, axis=0) for q, _ in motions], axis=0)
    # 10.0: position range, in top speeds over the cutoff [rad/s], from which a joint moves at all;
    # noise below the cutoff has about 5, a sine of a fifth of its frequency 10.
    moves = swept * 2.0 * np.pi * cutoff > 10.0 * top
    # Of a joint that moves slowly, its own speed decides; a still one has only noise.
    least = np.where(moves, np.minimum(SLOWEST * top.max(), MOVING * top), SLOWEST * top.max())
    # Share of a joint's top speed below which it may be at rest.
    return tuple(np.maximum(0.003 * top, least).tolist())


def find_rests(qd: Array, speeds: Sequence[float], rate: float) -> Mask:
    """Return where each joint is at rest, (L, n): slower than its speed for `PAUSE` or longer."""
    slow = np.ascontiguousarray(np.abs(qd.T) < np.asarray(speeds)[:, None])
    for slow_joint in slow:
        _keep_lasting(slow_joint, PAUSE * rate)
    return slow.T


def find_moving_ranges(still: Mask, rate: float, shoulder: int) -> list[tuple[int, int]]:
    """Return the index ranges without rests of all joints, but `shoulder` samples at their ends.

    During a rest friction takes any value up to the Coulomb torque, which a model whose friction
    follows the velocity does not describe.
    """
    rest = np.array(still.all(axis=1))
    _keep_lasting(rest, PAUSE * rate)
    keep = ~rest
    # What the parallel filter reaches of a rest stays, so that its outputs up to there exist.
    for a, b in find_true_ranges(rest):
        keep[a : a + shoulder if a > 0 else a] = True
        keep[max(b - shoulder, a) if b < rest.size else b : b] = True
    return find_true_ranges(keep)


@kernel("B1 f", usual=True)
def _keep_lasting(mask: Mask, samples: float) -> None:
    """Set runs of true values that are shorter than `samples` to false."""
    length = 0
    # One past the end closes a run that lasts to it.
    for k in range(mask.size + 1):
        if k < mask.size and mask[k]:
            length += 1
        else:
            if length < samples:
                for j in range(k - length, k):
                    mask[j] = False
            length = 0
