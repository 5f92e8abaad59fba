"""Equations of motion of the rigid bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.regressor import observation_matrix

Array = NDArray[np.float64]


def inverse_dynamics(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, parameters: ArrayLike | None = None, threads: int | None = None
) -> Array:
    """Return the joint torques of the rigid bodies [N m or N], shape of `q`."""
    chi = model.parameters if parameters is None else np.asarray(parameters, dtype=np.float64)
    return np.asarray((observation_matrix(model, q, qd, qdd) @ chi).reshape(np.shape(q)))
