"""Whether two torques are exchanged, told without CAD.

In the right order some masses and some friction explain them all.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.quality.torque_fit import BREAKAWAY, TorqueFit

DECISIVE = 4.0
"""Fall of the cost, the sum over joints of the logarithm of the unexplained share, from which an
exchange is believed: both shares fall to an eighth.
"""
FLOOR = 1e-3
"""Unexplained share below which a better fit counts no more."""
FEWEST_ROWS = 3
"""Torques per unknown below which anything is explained."""
LEAST_SINGULAR = 1e-10
"""Eigenvalue of the scaled normal equations, relative to the largest, below which a direction is
not excited.
"""


@dataclass(frozen=True, slots=True)
class Exchange:
    """Two joints (from 0) whose torques are exchanged, and the mean unexplained share of their
    torques as logged and exchanged.
    """

    joints: tuple[int, int]
    as_logged: float
    exchanged: float


def exchanged_torques(fit: TorqueFit) -> Exchange | None:
    """Return the exchange of two torques that base parameters, viscous and dry friction and offsets
    of any size explain far better than the order logged; None where none does.

    Each order has its own least squares, torques scaled to unit variance. CAD plays no part, so
    wrists, whose friction is as large as what their links do, are told apart as well.
    """
    n, samples = fit.model.n_joints, len(fit.q)
    base = find_base_parameters(fit.model, DriveSet.parse("viscous,offset"))
    p = base.n_base + n
    if samples * n < FEWEST_ROWS * p:
        return None
    pick, torque = list(fit.motion_of), fit.tau[:, list(fit.torque_of)]
    q, qd, qdd = (values[:, pick] for values in (fit.q, fit.qd, fit.qdd))
    W = np.zeros((samples, n, p))
    W[:, :, : base.n_base] = observation_matrix(
        fit.model, q, qd, qdd, drive=base.drive, columns=base.columns
    ).reshape(samples, n, -1)
    W[:, range(n), range(base.n_base, p)] = np.tanh(qd / BREAKAWAY)
    y = torque - torque.mean(axis=0)
    spread = y.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    y = y / spread
    normal = _Normal(
        np.einsum("skp,skq->kpq", W, W),
        np.einsum("skp,sj->kjp", W, y),
        np.mean(y**2, axis=0),
        spread,
        samples,
    )

    def cost(shares: Array) -> float:
        return float(np.sum(np.log(shares + FLOOR)))

    order = np.arange(n)
    logged = normal.unexplained(order)
    best, found = cost(logged) - DECISIVE, None
    for pair in combinations(range(n), 2):
        tried = order.copy()
        tried[list(pair)] = pair[::-1]
        shares = normal.unexplained(tried)
        if cost(shares) < best:
            both = list(pair)
            best, found = (
                cost(shares),
                Exchange(pair, float(logged[both].mean()), float(shares[both].mean())),
            )
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """The normal equations of each joint.

    `grams` (n, p, p), `sides` (n, n, p) of its rows with each torque, of unit variance, `power` and
    `spread` (n,) of the torques, scaled and as they are, and the samples.
    """

    grams: Array
    sides: Array
    power: Array
    spread: Array
    samples: int

    def unexplained(self, torque_of: NDArray[np.intp]) -> Array:
        """Return the unexplained share (n,) of the torque of every joint where joint k has torque
        `torque_of[k]`.
        """
        scale = 1.0 / self.spread[torque_of]
        side = np.stack([self.sides[k, j] for k, j in enumerate(torque_of)])
        gram = np.einsum("k,kpq->pq", scale**2, self.grams)
        size = np.sqrt(np.diag(gram))
        size = np.where(size > 0.0, size, 1.0)
        eigenvalues, axes = np.linalg.eigh(gram / np.outer(size, size))
        told = eigenvalues > LEAST_SINGULAR * eigenvalues[-1]
        axes = axes[:, told] / size[:, None]
        beta = axes @ ((axes.T @ (scale @ side)) / eigenvalues[told])
        residual = (
            self.power[torque_of]
            + (
                np.einsum("k,p,kpq,q->k", scale**2, beta, self.grams, beta)
                - 2.0 * scale * (side @ beta)
            )
            / self.samples
        )
        return np.asarray(np.maximum(residual, 0.0))
