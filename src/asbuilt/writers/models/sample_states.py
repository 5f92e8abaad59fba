"""Motions on which a written robot is compared with the model it was written from."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel

FASTEST = 3.0
"""Speed [rad/s or m/s] of a joint whose limit is not known."""
SHARPEST = 10.0
"""Acceleration [rad/s^2 or m/s^2]."""


def sample_states(model: RobotModel, count: int) -> tuple[Array, Array, Array]:
    """Return `count` random q, qd, qdd within the limits of the robot, each (count, n).

    Always the same ones for one robot.
    """
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
