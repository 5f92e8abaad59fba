"""Whether data held out repeat the motion that was fitted.

Then their errors tell how well the robot repeats itself, not how well the model predicts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from asbuilt.experiment.signal.samples import Samples

NEAR_POSITION, NEAR_VELOCITY = 0.03, 0.1
"""A state was there before where each joint came so near to it at once, in parts of the range and
of the top speed of the joint in the motion fitted.
"""
MOST_STATES = 20_000
"""States of either motion that are looked at, evenly spread."""
FEWEST_JOINTS = 3
"""Joints below which motions that differ pass near each other anyway."""


def repeated_share(fitted: Sequence[Samples], held_out: Samples) -> float:
    """Return the share of held-out states (q, qd) that the motion fitted came near to, each joint
    at the same time; 0 for robots of one or two joints.
    """
    if held_out.q.shape[1] < FEWEST_JOINTS:
        return 0.0
    before, after = np.concatenate([_states(samples) for samples in fitted]), _states(held_out)
    joints = before.shape[1] // 2
    size = np.concatenate(
        [
            NEAR_POSITION * np.ptp(before[:, :joints], axis=0),
            NEAR_VELOCITY * np.abs(before[:, joints:]).max(axis=0),
        ]
    )
    moving = size > 0.0
    if not moving[:joints].sum() >= FEWEST_JOINTS:
        return 0.0
    tree = KDTree((before[:: _step(len(before))] / np.where(moving, size, 1.0))[:, moving])
    distance, _ = tree.query(
        (after[:: _step(len(after))] / np.where(moving, size, 1.0))[:, moving],
        p=np.inf,
        distance_upper_bound=1.0,
    )
    return float(np.mean(np.isfinite(distance)))


def _states(samples: Samples) -> NDArray[np.float64]:
    return np.hstack([samples.q, samples.qd])


def _step(count: int) -> int:
    return max(1, count // MOST_STATES)
