"""Random states at which a written robot is compared with its model."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel

FASTEST = 3.0
"""Largest speed [rad/s or m/s]."""
SHARPEST = 10.0
"""Largest acceleration [rad/s^2 or m/s^2]."""


def sample_states(model: RobotModel, count: int) -> tuple[Array, Array, Array]:
    """Return `count` random q, qd, qdd within the limits, each (count, n); the same every time."""
    rng, n = np.random.default_rng(0), model.n_joints
    reach = [np.pi if joint.is_revolute else 0.5 for joint in model.joints]
    lower = np.array(
        [max(joint.limits.lower, -r) for joint, r in zip(model.joints, reach, strict=True)]
    )
    upper = np.array(
        [min(joint.limits.upper, r) for joint, r in zip(model.joints, reach, strict=True)]
    )
    speed = np.array([min(joint.limits.velocity, FASTEST) for joint in model.joints])
    q = lower + (np.maximum(upper, lower) - lower) * rng.uniform(size=(count, n))
    return (
        q,
        speed * rng.uniform(-1.0, 1.0, (count, n)),
        SHARPEST * rng.uniform(-1.0, 1.0, (count, n)),
    )
