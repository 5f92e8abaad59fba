"""Generalised momentum of a robot."""

# mypy: allow-untyped-calls

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.batches import inertial_parameters, shape_joint_samples
from asbuilt.dynamics.kernels import momentum as kernels


def generalised_momentum(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, *, parameters: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Return `p = M(q) qd` and `C(q, qd)^T qd` of the rigid bodies, two of the shape of `q`.

    `C^T qd = dM/dt qd - C qd` is the gradient of kinetic energy by position, so it is the same for
    every factor C with `dM/dt = C + C^T`.

    Parameters
    ----------
    model
        The robot.
    q, qd
        Positions [rad or m] and velocities, shape (n,) or (N, n).
    parameters
        Standard inertial parameters (10 n_links,), by default the model's own.

    Raises
    ------
    UsageError
        For shapes that do not fit, and values that are not finite.
    """
    qs, qds = shape_joint_samples(model, q=q, qd=qd)
    p, gradient = Momentum(model, inertial_parameters(model, parameters))(qs, qds)
    return p.reshape(np.shape(q)), gradient.reshape(np.shape(q))


class Momentum:
    """Evaluate `p = M(q) qd` and `C(q, qd)^T qd` of states (N, n) that are trusted.

    `chi` (n_links, 10) are the inertial parameters; the states are contiguous doubles.
    """

    def __init__(self, model: RobotModel, chi: Array) -> None:
        self._coupling = model.coupling
        self._mechanism = build_mechanism_arrays(model.tree)
        self._chi = np.ascontiguousarray(
            chi if self._coupling is None else self._coupling.parameters(chi)
        )

    def __call__(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return p and the gradient of kinetic energy, two (N, n)."""
        coupling = self._coupling
        moved = None if coupling is None else coupling.motion(q, qd)
        state = (q, qd) if moved is None else (moved.q, moved.qd)
        p, gradient = np.empty(state[0].shape), np.empty(state[0].shape)
        kernels.momentum(*self._mechanism, self._chi, *state, p, gradient)
        if coupling is None or moved is None:
            return p, gradient
        own, turning = moved.torques(gradient), coupling.derivatives(q, qd, np.zeros_like(q))
        if turning is not None:  # kinetic energy also changes as the shares do
            own += np.einsum("si,sij->sj", p, turning.turning)
        return moved.torques(p), own


@lru_cache(maxsize=16)
def build_mechanism_arrays(model: RobotModel) -> tuple[Any, ...]:
    """Return parents, kinds and placements of the joints as the kernel takes them."""
    return (
        np.array(model.parents, dtype=np.int64),
        np.array([joint.is_revolute for joint in model.joints]),
        np.array([joint.before for joint in model.joints], dtype=np.float64),
        np.array([joint.after for joint in model.joints], dtype=np.float64),
    )


def apply_lag(share: Array, x: Array, start: Array | None = None) -> Array:
    """Return the first-order lag of x (N, m).

    `y_k = y_(k-1) + share_k (x_k - y_(k-1))`, from `start` (m,) or 0, with shares (N,); a negative
    share starts again at 0.
    """
    out = np.empty(x.shape)
    begin = np.zeros(x.shape[1]) if start is None else np.array(start, dtype=np.float64)
    kernels.lag(share, np.ascontiguousarray(x), begin, out)
    return out
