"""Regressor of a tree of bodies by Pinocchio, for every tool that has none of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from adapter import Facts

FROM_PINOCCHIO = np.array([4, 5, 7, 6, 8, 9, 1, 2, 3, 0])
"""Order `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m` from Pinocchio's `m mx my mz Ixx Ixy Iyy Ixz ...`."""


def tree_regressor(facts: Facts) -> Any:
    """Return Pinocchio's regressor of the tree, columns link by link in the order of the joints."""
    model = pin.buildModelFromUrdf(facts.urdf)
    model.gravity.linear = np.array(facts.gravity)
    data = model.createData()
    joints = [model.getJointId(name) for name in facts.tree_joints]
    rows = [model.joints[j].idx_v for j in joints]
    columns = np.concatenate([10 * (j - 1) + FROM_PINOCCHIO for j in joints])
    turning = [model.joints[j].nq == 2 for j in joints]

    def regressor(q: Any, qd: Any, qdd: Any) -> Any:
        found = np.empty((len(q), len(rows), len(columns)))
        v, a, configuration = np.zeros(model.nv), np.zeros(model.nv), np.zeros(model.nq)
        for i in range(len(q)):
            v[rows], a[rows] = qd[i], qdd[i]
            for k, j in enumerate(joints):
                place = model.joints[j].idx_q
                configuration[place : place + 1 + turning[k]] = (
                    [np.cos(q[i, k]), np.sin(q[i, k])] if turning[k] else q[i, k]
                )
            Y = pin.computeJointTorqueRegressor(model, data, configuration, v, a)
            found[i] = Y[np.ix_(rows, columns)]
        return found

    return regressor
