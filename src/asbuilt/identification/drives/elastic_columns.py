"""Torque of elastic joints to first order, as columns of the joints' compliances."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics


def elastic_columns(
    model: RobotModel,
    chi: ArrayLike,
    state: Array,
    rate: float,
    joint: int,
    *,
    load: Array | None = None,
) -> Array:
    """Return the torque of each joint per compliance of one joint, shape (N, n).

    With encoders at the motors and a stiffness K_k [N m/rad or N/m] between motor and link k, the
    link lags by `tau_k / K_k`, tau_k the torque that the spring transmits. To first order in the
    compliance `c_k = 1 / K_k` the torque at the logged positions is that of the stiff robot plus

        sum_k c_k column_k,   column_k = -(D_q tau_k + D_qd dtau_k/dt + D_qdd d2tau_k/dt2),

    D the derivative of all torques by position, velocity and acceleration of joint k. Friction and
    rotors are at the motors, where the logged motion is theirs. Compliances are small where their
    lag is.

    Parameters
    ----------
    model
        The robot.
    chi
        Standard parameters of its links (10 n_links,); parameters that follow are not used.
    state
        Positions, velocities and accelerations (3, N, n) without gaps.
    rate
        Samples a second; tau_k is differentiated by central differences, which lose a share
        `(2 pi f / rate)^2 / 3` at the frequency f.
    joint
        The joint, from 0.
    load
        Torque of the rigid bodies (N, n), if it is known.

    Source: Spong, Modeling and control of elastic joint robots, ASME J. Dyn. Sys. Meas. Control
    109, 1987: the slow manifold to first order in 1 / K.
    """
    links = np.asarray(chi, dtype=np.float64)[: 10 * model.n_links]
    rigid = inverse_dynamics(model, *state, parameters=links) if load is None else load
    own = rigid[:, joint]
    if len(own) < 3:
        return np.zeros_like(rigid)
    first = np.gradient(own, 1.0 / rate, edge_order=2)
    lag = np.stack([own, first, np.gradient(first, 1.0 / rate, edge_order=2)])
    # Largest lag [rad or m] of the central differences; their error is of its square, 1e-8.
    step = 1e-4 / max(float(np.abs(own).max()), np.finfo(float).tiny)
    moved = np.zeros_like(state)
    moved[:, :, joint] = step * lag
    ahead, behind = (
        inverse_dynamics(model, *(state + sign * moved), parameters=links) for sign in (1.0, -1.0)
    )
    return np.asarray((behind - ahead) / (2.0 * step))
