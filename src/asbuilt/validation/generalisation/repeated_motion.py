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


def repeated_share(fitted: Sequence[Samples], held_out: Samples) -> float:
    """Return the share of held-out states (q, qd) that the training motion came near to.

    All joints must be near at the same time; 0 for robots of one or two joints.
    """
    if held_out.q.shape[1] < NEAR.fewest_joints:
        return 0.0
    before, after = np.concatenate([_states(samples) for samples in fitted]), _states(held_out)
    joints = before.shape[1] // 2
    size = np.concatenate(
        [
            NEAR.position * np.ptp(before[:, :joints], axis=0),
            NEAR.velocity * np.abs(before[:, joints:]).max(axis=0),
        ]
    )
    moving = size > 0.0
    if not moving[:joints].sum() >= NEAR.fewest_joints:
        return 0.0
    tree = KDTree((before[:: _step(len(before))] / np.where(moving, size, 1.0))[:, moving])
    distance, _ = tree.query(
        (after[:: _step(len(after))] / np.where(moving, size, 1.0))[:, moving],
        p=np.inf,
        distance_upper_bound=1.0,
    )
    return float(np.mean(np.isfinite(distance)))


def _states(samples: Samples) -> NDArray[np.float64]:
    return np.hstack([samples.in_segments(x) for x in (samples.q, samples.qd)])


def _step(count: int) -> int:
    return max(1, count // NEAR.most_states)
