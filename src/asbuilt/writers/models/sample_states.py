"""Random states at which a written robot is compared with its model."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel


def draw_sample_states(model: RobotModel, count: int) -> tuple[Array, Array, Array]:
    """Return `count` random q, qd, qdd within the limits, each (count, n); the same every time."""
    # A fixed seed: the same file gives the same note.
    rng = np.random.default_rng(0)
    n = model.n_joints
    # A turn, or half a metre, stands for limits that a joint does not have.
    reach = [np.pi if joint.is_revolute else 0.5 for joint in model.joints]
    lower = np.array(
        [max(joint.limits.lower, -r) for joint, r in zip(model.joints, reach, strict=True)]
    )
    upper = np.array(
        [min(joint.limits.upper, r) for joint, r in zip(model.joints, reach, strict=True)]
    )
    # Largest speed [rad/s or m/s].
    speed = np.array([min(joint.limits.velocity, 3.0) for joint in model.joints])
    # Limits apart from zero may leave upper below lower: the joint is held there.
    q = lower + (np.maximum(upper, lower) - lower) * rng.uniform(size=(count, n))
    # Largest acceleration [rad/s^2 or m/s^2].
    return (
        q,
        speed * rng.uniform(-1.0, 1.0, (count, n)),
        10.0 * rng.uniform(-1.0, 1.0, (count, n)),
    )
