"""Whether validation data repeat the training motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True)
class Nearness:
    """Say when two states of a robot are near each other; own choices, tested on real robots.

    Each joint must be within `position` of its range and `velocity` of its top speed in the
    training motion at once. At most `most_states` of either motion are looked at, evenly spread;
    with fewer than `fewest_joints`, different motions pass near each other anyway.
    """

    position: float = 0.03
    velocity: float = 0.1
    most_states: int = 20_000
    fewest_joints: int = 3


NEAR = Nearness()


def measure_repeated_share(fitted: Sequence[Samples], held_out: Samples) -> float:
    """Return the share of held-out states (q, qd) that the training motion came near to.

    All joints must be near at the same time; 0 for robots of one or two joints.
    """
    if held_out.q.shape[1] < NEAR.fewest_joints:
        return 0.0
    (q, qd), joints = _stack_states(fitted), held_out.q.shape[1]
    fastest = np.maximum(qd.max(axis=0), -qd.min(axis=0))
    size = np.concatenate([NEAR.position * np.ptp(q, axis=0), NEAR.velocity * fastest])
    moving = size > 0.0
    if not moving[:joints].sum() >= NEAR.fewest_joints:
        return 0.0
    before, after = _thinned(q, qd), _thinned(*_stack_states([held_out]))
    tree = KDTree((before / np.where(moving, size, 1.0))[:, moving])
    distance, _ = tree.query(
        (after / np.where(moving, size, 1.0))[:, moving],
        p=np.inf,
        distance_upper_bound=1.0,
    )
    return float(np.mean(np.isfinite(distance)))


def _stack_states(samples: Sequence[Samples]) -> list[NDArray[np.float64]]:
    """Return all positions and velocities (N, n), without a copy of those of one recording."""
    pairs = zip(
        *([each.in_segments(x) for x in (each.q, each.qd)] for each in samples), strict=True
    )
    return [parts[0] if len(parts) == 1 else np.concatenate(parts) for parts in pairs]


def _thinned(q: NDArray[np.float64], qd: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return states (q, qd), evenly spread."""
    step = max(1, len(q) // NEAR.most_states)
    return np.hstack([q[::step], qd[::step]])
