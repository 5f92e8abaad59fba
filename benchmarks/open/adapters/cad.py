"""The maker's description as it is, without friction: what a user has before any identification."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from adapter import Facts, Fit
from pinocchio_regressor import FROM_PINOCCHIO, tree_regressor
from regression import Regression

PACKAGE = "pin"
REQUIRES = ["pin>=3.4", "scipy"]
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
