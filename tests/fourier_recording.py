"""A clean recording of any robot, for tests to spoil."""

from __future__ import annotations

import numpy as np

from asbuilt.description import RobotModel
from asbuilt.dynamics import inverse_dynamics
from asbuilt.experiment import Recording


def record(model: RobotModel, seed: int, torque: object = None) -> Recording:
    """Move every joint on its own Fourier course.

    The robot differs from the model by 20 % per link, rubs, and is noisy.
    """
    rng = np.random.default_rng(seed)
    t, n = np.arange(4000) / 200, model.n_joints
    w = 2 * np.pi * np.arange(1, 6) / 10
    a, b = rng.normal(size=(2, 5, n)) / np.arange(1, 6)[:, None]
    sine, cosine = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    q = sine @ a + cosine @ b
    low = np.maximum([joint.limits.lower for joint in model.joints], -2.5)
    high = np.minimum([joint.limits.upper for joint in model.joints], 2.5)
    qd = cosine @ (a * w[:, None]) - sine @ (b * w[:, None])
    speed = np.array([joint.limits.velocity for joint in model.joints])
    scale = np.minimum(
        0.45 * (high - low) / np.max(np.abs(q), axis=0), 0.9 * speed / np.max(np.abs(qd), axis=0)
    )
    q, qd, qdd = (
        q * scale + (low + high) / 2,
        qd * scale,
        -(sine @ (a * w[:, None] ** 2) + cosine @ (b * w[:, None] ** 2)) * scale,
    )
    if torque is None:
        built = model.parameters * np.repeat(1 + 0.2 * rng.uniform(-1, 1, n), 10)
        tau = inverse_dynamics(model, q, qd, qdd, parameters=built)
    else:
        tau = np.array([torque(*row) for row in zip(q, qd, qdd, strict=True)])  # type: ignore[operator]
    size = 0.3 + 0.03 * np.max(np.abs(tau), axis=0)
    tau = tau + size * np.tanh(qd / 0.01) + size * qd + 0.05 * size * rng.normal(size=tau.shape)
    noise = rng.normal(size=(2, *q.shape))
    return Recording(
        t,
        q + 1e-5 * noise[0],
        tau,
        qd + 1e-3 * noise[1],
        joint_names=model.joint_names,
        source="log.csv",
    )
