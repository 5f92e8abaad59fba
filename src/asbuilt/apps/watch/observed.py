"""What an observer makes of a log, and the error of the torque that its model predicts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Mask
from asbuilt.description import RobotModel
from asbuilt.dynamics import DriveSet, observation_matrix
from asbuilt.identification import IdentificationResult
from asbuilt.scaled import Scaled

CHUNK = 2000
"""Samples of a regressor that are held at once."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelError:
    """Propagate the covariance of base parameters: `Y cov Y^T = (Y L) (Y L)^T`.

    Parameters
    ----------
    model, drive, columns
        The regressor: robot, drive terms and the columns of the base parameters.
    factor
        L (p, k) with `L L^T` the covariance; k = 0 where the parameters count as exact.
    """

    model: RobotModel
    drive: DriveSet
    columns: NDArray[Any]
    factor: Array

    @classmethod
    def of(cls, robot: Any) -> ModelError:
        """Return the error of an identified robot; a described robot counts as exact."""
        if not isinstance(robot, IdentificationResult):
            empty = np.empty((0, 0))
            return cls(getattr(robot, "model", robot), DriveSet(()), np.empty(0, int), empty)
        return cls(
            robot.model,
            robot.base.drive,
            robot.base.columns,
            np.ascontiguousarray(Scaled(np.array(robot.covariance)).root.T),
        )

    @property
    def is_known(self) -> bool:
        """Whether there is any covariance."""
        return bool(self.factor.shape[1] > 0)

    def std(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the standard deviation of the torque of each joint (N, n) at states (N, n)."""
        out = np.zeros(q.shape)
        for start in range(0, len(q) if self.is_known else 0, CHUNK):
            part = slice(start, start + CHUNK)
            spread = self._spread(q[part], qd[part], qdd[part])
            out[part] = np.sqrt(np.einsum("sjk,sjk->sj", spread, spread))
        return out

    def covariance(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the covariance (n, n) of the torques of one state (n,)."""
        if not self.is_known:
            return np.zeros((q.size, q.size))
        spread = self._spread(q[None], qd[None], qdd[None])[0]
        return np.asarray(spread @ spread.T)

    def _spread(self, q: Array, qd: Array, qdd: Array) -> Array:
        rows = observation_matrix(
            self.model, q, qd, qdd, drive=self.drive, columns=self.columns, threads=1
        )
        return np.asarray(rows @ self.factor).reshape(*q.shape, -1)


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Hold what an observer makes of a log.

    `t` (N,), `share` (N,) the weight of each new sample, -1 where the observer starts again; `q`,
    `qd`, the lagged acceleration `qdd`, the lagged size `step` of the steps of torque between
    samples, the lagged largest error `unknown_friction` of friction whose direction is unknown, and
    the `residual` (N, n) [N m or N]. `left_out` rows of the log were not valid.
    """

    t: Array
    share: Array
    q: Array
    qd: Array
    qdd: Array
    step: Array
    unknown_friction: Array
    residual: Array
    left_out: int = field(default=0, kw_only=True)

    @property
    def seconds(self) -> float:
        """Time that was observed [s]: without gaps, and without what settles the causal filter."""
        return float(np.diff(self.t)[self.share[1:] > 0.0].sum())

    def part(self, rows: slice) -> Observed:
        """Return adjacent samples."""
        return Observed(self.t[rows], self.share[rows], *(x[rows] for x in self._of_joints))

    def select(self, keep: Mask) -> Observed:
        """Return the samples where `keep` (N,) is true; lags start again after a gap."""
        share = self.share.copy()
        share[1:][~keep[:-1]] = -1.0
        return Observed(
            self.t[keep],
            share[keep],
            *(np.ascontiguousarray(x[keep]) for x in self._of_joints),
        )

    @property
    def _of_joints(self) -> tuple[Array, ...]:
        return self.q, self.qd, self.qdd, self.step, self.unknown_friction, self.residual
