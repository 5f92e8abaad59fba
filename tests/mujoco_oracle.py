"""Inverse dynamics by MuJoCo, an engine independent of asbuilt's own."""

from __future__ import annotations

import mujoco
import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.virtual.physics import Physics


def inverse_dynamics(physics: Physics, q: Array, qd: Array, qdd: Array) -> Array:
    """Return MuJoCo's torque (N, n) for states (N, n).

    Rigid bodies, armature and viscous friction, without dry friction.
    """
    torque = np.empty(np.atleast_2d(q).shape)
    options = physics.compiled.opt
    flags = options.disableflags
    options.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = physics.data
    every = physics.every
    moved = physics.model.link_motion(*(np.atleast_2d(x) for x in (q, qd, qdd)))
    for k in range(len(torque)):
        data.qpos[every] = moved.q[k]
        data.qvel[every] = moved.qd[k]
        data.qacc[every] = moved.qdd[k]
        mujoco.mj_inverse(physics.compiled, data)
        torque[k] = data.qfrc_inverse[every] @ moved.by_sample[k % len(moved.by_sample)]
    options.disableflags = flags
    return torque
