"""Detection of swapped torque columns by a fit of base parameters, without CAD values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.quality.torque.torque_fit import (
    BREAKAWAY,
    TorqueFit,
    decisive_change,
    swaps,
)


@dataclass(frozen=True, slots=True)
class SwapThresholds:
    """Decide from the sum over joints of the logarithm of the unexplained variance."""

    fall: float = 4.0
    """Fall of the sum from which a swap is decisive: both shares fall to an eighth."""
    floor: float = 1e-3
    """Unexplained share below which a better fit does not count."""
    each: float = 0.5
    """Largest unexplained share of each of the two torques, relative to that as logged: a torque
    that is constant, or noise alone, is explained no better at another joint."""
    rows_per_parameter: int = 3
    """Torques per parameter below which any order is explained."""
    singular: float = 1e-10
    """Relative eigenvalue of the scaled normal equations of a direction that is not excited."""


THRESHOLDS = SwapThresholds()


@dataclass(frozen=True, slots=True)
class TorqueSwap:
    """Hold two joints (from 0) whose torques are swapped, and their mean unexplained variance.

    Both shares are fractions of the torque's variance, in the order logged and after swapping.
    """

    joints: tuple[int, int]
    as_logged: float
    swapped: float


def swapped_torques(fit: TorqueFit) -> TorqueSwap | None:
    """Return the swap of two torques that base parameters and friction explain decisively better.

    Each order has its own least-squares fit of base parameters, viscous and Coulomb friction and
    offsets, torques scaled to unit variance. CAD values are not used, so the wrists of an arm,
    where friction exceeds the rigid-body torque, are checked too.
    """
    n, samples = fit.model.n_joints, len(fit.q)
    base = find_base_parameters(fit.model, DriveSet.parse("viscous,offset"))
    p = base.n_base + n
    if samples * n < THRESHOLDS.rows_per_parameter * p:
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
    normal = _NormalEquations(
        W.transpose(1, 2, 0) @ W.transpose(1, 0, 2),
        y.T @ W.transpose(1, 0, 2),
        np.mean(y**2, axis=0),
        spread,
        samples,
    )
    logged = tuple(range(n))
    found = decisive_change(
        logged,
        swaps(logged),
        normal.cost,
        THRESHOLDS.fall,
    )
    if found is None:
        return None
    i, j = (k for k in range(n) if found[k] != k)
    before, after = (normal.unexplained(order)[[i, j]].mean() for order in (logged, found))
    return TorqueSwap((i, j), float(before), float(after))


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """The normal equations of each joint's rows with each joint's torque.

    `grams` (n, p, p), `sides` (n, n, p) for torques of unit variance, `power` and `spread` (n,) of
    the torques, scaled and as logged.
    """

    grams: Array
    sides: Array
    power: Array
    spread: Array
    samples: int

    def cost(self, torque_of: tuple[int, ...]) -> float:
        """Return the sum of logarithms of the unexplained shares, if each torque moved gains."""
        logged = self.unexplained(tuple(range(len(torque_of)))) + THRESHOLDS.floor
        shares = self.unexplained(torque_of) + THRESHOLDS.floor
        moved = [(k, j) for k, j in enumerate(torque_of) if k != j]
        if any(self.power[j] == 0.0 or shares[k] > THRESHOLDS.each * logged[j] for k, j in moved):
            return np.inf
        return float(np.sum(np.log(shares)))

    def unexplained(self, torque_of: tuple[int, ...]) -> Array:
        """Return the unexplained share (n,) of the torques if joint k has `torque_of[k]`."""
        order = list(torque_of)
        scale = 1.0 / self.spread[order]
        side = np.stack([self.sides[k, j] for k, j in enumerate(order)])
        gram = np.tensordot(scale**2, self.grams, axes=1)
        size = np.sqrt(np.diag(gram))
        size = np.where(size > 0.0, size, 1.0)
        eigenvalues, axes = np.linalg.eigh(gram / np.outer(size, size))
        excited = eigenvalues > THRESHOLDS.singular * eigenvalues[-1]
        axes = axes[:, excited] / size[:, None]
        beta = axes @ ((axes.T @ (scale @ side)) / eigenvalues[excited])
        explained = scale**2 * (self.grams @ beta @ beta)
        residual = self.power[order] + (explained - 2.0 * scale * (side @ beta)) / self.samples
        return np.asarray(np.maximum(residual, 0.0))
