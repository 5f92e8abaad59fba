"""How well the measured torques follow the model's, under one assignment of columns to joints or
another.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.quality.smoothed_motion import SmoothedMotion

BREAKAWAY = 0.02
"""Width of the sign of velocity [rad/s or m/s]."""
_FLOOR = 0.02
"""Misfit below which a better fit counts no more."""
_DECISIVE = 2.0
"""Fall of the cost from which an exchange of joints is believed.

A misfit of one joint that falls to an eighth.
"""
_MOST_SAMPLES = 400
"""Samples that are enough for it."""
_MOST_JOINTS = 10
"""On robots of more joints exchanged torques alone are looked for, which takes long enough."""


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Compare torque columns with the model's rigid-body torques, offset and friction of each joint
    taken out of both.

    `motion_of[k]` and `torque_of[k]` are the columns taken for joint k. Measured y_k and predicted
    x_k are what is left of each after projection on 1, qd_k and tanh(qd_k / 0.02).
    """

    model: RobotModel
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    motion_of: tuple[int, ...]
    torque_of: tuple[int, ...]

    @classmethod
    def of(
        cls, model: RobotModel, motion: SmoothedMotion, scale: Array, torque_scale: float = 1.0
    ) -> TorqueFit:
        """Compare a recording's smoothed motion, positions multiplied by `scale` (n,), under the
        logged order of joints.
        """
        rows = motion.thinned(_MOST_SAMPLES)
        order = tuple(range(model.n_joints))
        return cls(
            model,
            motion.q[rows] * scale,
            motion.qd[rows] * scale,
            motion.qdd[rows] * scale,
            motion.tau[rows] * torque_scale,
            order,
            order,
        )

    @cached_property
    def _residuals(self) -> tuple[Array, Array]:
        pick = list(self.motion_of)
        qd = self.qd[:, pick]
        x = inverse_dynamics(self.model, self.q[:, pick], qd, self.qdd[:, pick], threads=1)
        y = self.tau[:, list(self.torque_of)].copy()
        for k in range(x.shape[1]):
            basis, _ = np.linalg.qr(
                np.column_stack([np.ones(len(qd)), qd[:, k], np.tanh(qd[:, k] / BREAKAWAY)])
            )
            x[:, k] -= basis @ (basis.T @ x[:, k])
            y[:, k] -= basis @ (basis.T @ y[:, k])
        return x, y

    @property
    def predicted(self) -> Array:
        """Standard deviation of the predicted torque of each joint [N m], shape (n,)."""
        deviation: Array = np.std(self._residuals[0], axis=0)
        return deviation

    @property
    def measured(self) -> Array:
        """Standard deviation of the measured torque of each joint [N m], shape (n,)."""
        deviation: Array = np.std(self._residuals[1], axis=0)
        return deviation

    @property
    def correlation(self) -> Array:
        """Correlation of measured with predicted torque, joint by joint, shape (n,)."""
        x, y = self._residuals
        norms = np.linalg.norm(x, axis=0) * np.linalg.norm(y, axis=0)
        dots: Array = np.sum(x * y, axis=0)
        likeness: Array = dots / np.where(norms > 0, norms, 1.0)
        return likeness

    @property
    def gain(self) -> Array:
        """Least-squares factor from predicted to measured torque, joint by joint, shape (n,)."""
        x, y = self._residuals
        energy = np.sum(x**2, axis=0)
        factor: Array = np.sum(x * y, axis=0) / np.where(energy > 0, energy, 1.0)
        return factor

    @property
    def friction_correlation(self) -> Array:
        """Correlation of each joint's torque with its direction of motion tanh(qd_k / 0.02), shape
        (n,), every rigid-body torque taken out of both.

        What any masses could explain is projected out, so CAD does not matter; joints whose
        friction moves less than a tenth of their torque get 0.
        """
        pick = list(self.motion_of)
        base = find_base_parameters(self.model, DriveSet.parse("offset"))
        q, qd, qdd = (values[:, pick] for values in (self.q, self.qd, self.qdd))
        observed = observation_matrix(
            self.model, q, qd, qdd, drive=base.drive, columns=base.columns
        )
        rows = observed.reshape(*q.shape, base.n_base)
        likeness = np.zeros(q.shape[1])
        for k in range(q.shape[1]):
            lengths = np.linalg.norm(rows[:, k], axis=0)
            basis, values, _ = np.linalg.svd(
                rows[:, k, lengths > 0] / lengths[lengths > 0], full_matrices=False
            )
            basis = basis[:, values > 1e-6 * values[0]]
            both = np.column_stack([np.tanh(qd[:, k] / BREAKAWAY), self.tau[:, self.torque_of[k]]])
            way, left = (both - basis @ (basis.T @ both)).T
            norm = float(np.linalg.norm(way) * np.linalg.norm(left))
            if norm > 0 and abs(way @ left) / np.linalg.norm(way) > 0.1 * np.linalg.norm(
                both[:, 1] - both[:, 1].mean()
            ):
                likeness[k] = way @ left / norm
        return likeness

    def misfit(self, sign: int) -> Array:
        """Return `|y_k - sign x_k|^2 / (|y_k|^2 + |x_k|^2)` of each joint, shape (n,)."""
        x, y = self._residuals
        scale = np.sum(x**2, axis=0) + np.sum(y**2, axis=0)
        share: Array = np.sum((y - sign * x) ** 2, axis=0) / np.where(scale > 0, scale, 1.0)
        return share

    @property
    def cost(self) -> float:
        """Sum over joints of the logarithm of the misfit, for the better of the two signs of all
        torques.
        """
        return min(float(np.sum(np.log(self.misfit(sign) + _FLOOR))) for sign in (1, -1))

    def neighbours(self) -> Iterator[TorqueFit]:
        """Yield the fits with two joints exchanged: their torques, their motions, or both."""
        n = self.model.n_joints
        for i in range(n):
            for j in range(i + 1, n):
                torque_of, motion_of = (
                    _exchanged(self.torque_of, i, j),
                    _exchanged(self.motion_of, i, j),
                )
                yield replace(self, torque_of=torque_of)
                if n <= _MOST_JOINTS:
                    yield replace(self, torque_of=torque_of, motion_of=motion_of)
                    yield replace(self, motion_of=motion_of)


def best_assignment(fit: TorqueFit) -> TorqueFit:
    """Exchange pairs of joints as long as the torques fit decisively better.

    The cost falls by 2 and an exchanged joint then fits well.
    """
    best = fit
    for _ in range(fit.model.n_joints):
        candidate = min(best.neighbours(), key=lambda other: other.cost, default=best)
        if best.cost - candidate.cost < _DECISIVE:
            break
        changed = [
            k
            for k in range(fit.model.n_joints)
            if (candidate.torque_of[k], candidate.motion_of[k])
            != (best.torque_of[k], best.motion_of[k])
        ]
        if max(abs(candidate.correlation[changed])) < 0.9:
            break
        best = candidate
    return best


def _exchanged(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    changed = list(order)
    changed[i], changed[j] = changed[j], changed[i]
    return tuple(changed)
