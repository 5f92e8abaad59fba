"""Windows of a task without torque, simulated by MuJoCo under the logged command."""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from adapter import Facts
from plain import uniform

STEP = 0.0025
"""Step of the simulation [s]."""


def without_limits(spec: Any) -> None:
    """Let joints and bodies touch nothing."""
    spec.option.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )


def simulated(facts: Facts, model: Any, log: dict[str, Any]) -> Any:
    """Return the positions (W, L, n) in the windows of a test."""
    length, paths = round(facts.horizon * facts.rate), []
    data = [mujoco.MjData(model)]
    every = round(1.0 / (facts.rate * STEP))
    steps = STEP * np.arange(every * (length - 1))
    for start, q, qd in zip(log["start"], log["q"], log["qd"], strict=True):
        command = uniform(log["t"], log["u"], start + steps)
        begin = np.concatenate([[0.0], q, qd, np.zeros(model.na)])
        states, _ = mujoco.rollout.rollout(model, data, begin[None], command[None])
        paths.append(np.vstack([q, states[0, every - 1 :: every, 1 : 1 + len(q)]]))
    return np.array(paths)
