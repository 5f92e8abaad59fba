"""Torque of elastic joints to first order, as columns of the joints' compliances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

STEP = 1e-4
"""Largest lag [rad or m] of the central differences; their error is of its square, 1e-8."""


def elastic_columns(model: RobotModel, chi: ArrayLike, samples: Samples) -> Array:
    """Return the torque of each joint per compliance of each joint, shape (N, n, n).

    With encoders at the motors and a stiffness K_k [N m/rad or N/m] between motor and link k, the
    link lags by `tau_k / K_k`, tau_k the torque that the spring transmits. To first order in the
    compliance `c_k = 1 / K_k` the torque at the logged positions is that of the stiff robot plus

        sum_k c_k column_k,   column_k = -(D_q tau_k + D_qd dtau_k/dt + D_qdd d2tau_k/dt2),

    D the derivative of all torques by position, velocity and acceleration of joint k. Friction and
    rotors are at the motors, where the logged motion is theirs. `result[:, i, k]` is the torque of
    joint i by the compliance of joint k; compliances are small where their lag is.

    Parameters
    ----------
    model
        The robot.
    chi
        Standard parameters of its links (10 n_links,); parameters that follow are not used.
    samples
        Motion; tau_k is differentiated by central differences within each segment, which loses
        a share `(2 pi f / rate)^2 / 3` at the frequency f.

    Source: Spong, Modeling and control of elastic joint robots, ASME J. Dyn. Sys. Meas. Control
    109, 1987: the slow manifold to first order in 1 / K.
    """
    links = np.asarray(chi, dtype=np.float64)[: 10 * model.n_links]
    state = np.stack([samples.q, samples.qd, samples.qdd])
    load = inverse_dynamics(model, *state, parameters=links)
    rates = _rate(load, samples)
    lag = np.stack([load, rates, _rate(rates, samples)])
    columns = np.empty((*load.shape, load.shape[1]))
    for k in range(load.shape[1]):
        step = STEP / max(float(np.abs(load[:, k]).max()), np.finfo(float).tiny)
        moved = np.zeros_like(state)
        moved[:, :, k] = step * lag[:, :, k]
        ahead, behind = (
            inverse_dynamics(model, *(state + sign * moved), parameters=links)
            for sign in (1.0, -1.0)
        )
        columns[:, :, k] = (behind - ahead) / (2.0 * step)
    return columns


def _rate(values: Array, samples: Samples) -> Array:
    """Return the time derivative of values (N, n) segment by segment, 0 where one is too short."""
    rate = np.zeros_like(values)
    for start, stop in samples.segments:
        if stop - start > 2:
            part = values[start:stop]
            rate[start:stop] = np.gradient(part, 1.0 / samples.rate, axis=0, edge_order=2)
    return rate
