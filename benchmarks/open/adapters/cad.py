"""The maker's description as it is, without friction: what a user has before any identification."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
from adapter import Facts, Fit
from flyer import Flyer, described
from mujoco_rollout import STEP, simulated, without_limits
from pinocchio_regressor import FROM_PINOCCHIO, tree_regressor
from regression import Regression

PACKAGE = "pin"
REQUIRES = ["pin>=3.4", "mujoco>=4.0", "scipy"]
TITLE = "the description as it is"
ADDRESS = "https://github.com/stack-of-tasks/pinocchio"


def fit(facts: Facts) -> Fit:
    """Return the values of the description."""
    model = pin.buildModelFromUrdf(facts.urdf)
    joints = [model.getJointId(name) for name in facts.tree_joints]
    links = np.array([model.inertias[j].toDynamicParameters()[FROM_PINOCCHIO] for j in joints])
    known = Regression(facts, tree_regressor(facts))
    standard = np.concatenate([links.ravel(), np.zeros(len(known.names) - links.size)])
    if not np.any(standard):
        raise NotImplementedError("the description has no masses")
    return Fit(lambda motion: known.torque(motion, standard), links=links)


def fit_legs(facts: Facts) -> Fit:
    """Return the values of the description of a robot with a free base."""
    known, links = Flyer(facts), described(facts)
    standard = np.concatenate([links.ravel(), np.zeros(len(known.names) - links.size)])
    return Fit(lambda motion: known.torque(motion, standard), links=links)


def follow(facts: Facts) -> list[Any]:
    """Simulate the windows of the tests with the description as it is."""
    spec = mujoco.MjSpec.from_file(facts.description)
    spec.option.timestep = STEP
    without_limits(spec)
    model = spec.compile()
    return [simulated(facts, model, log) for log in facts.logs(facts.test)]
