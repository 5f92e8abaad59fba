"""The torque limit as a constraint on the joint state, for one description of the robot or for several that it might be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drive_torque import described_drive, drive_torque
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.dynamics.regressor_adjoint import regressor_adjoint
from asbuilt.excitation.interior_point import Linearised, StateConstraint
from asbuilt.excitation.motion import Array

SIGN_WIDTH = 0.02
"""Width [rad/s or m/s] over which the sign in a described friction is smoothed where its derivative is needed."""


class TorqueLimit(StateConstraint):
    """Keep `|tau| / limit` below 1 for the rigid bodies and the drive values of every given description."""

    name = "torque"
    two_sided = True

    def __init__(self, models: Sequence[RobotModel], limit: Array) -> None:
        self._models = tuple(models)
        self._limit = limit
        self._finite = np.flatnonzero(np.isfinite(limit))
        self._drive, self._values = described_drive(models[0])
        self._plan = RegressorPlan.of(models[0], columns=np.zeros(0, dtype=np.int64))

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque over its limit, (N, models x limited joints)."""
        found = []
        for model in self._models:
            rigid = inverse_dynamics(model, q, qd, qdd, threads=1)
            found.append(((rigid + self._friction(q, qd, qdd, rigid)) / self._limit)[:, self._finite])
        return np.hstack(found)

    def linearised(self, q: Array, qd: Array, qdd: Array) -> Linearised:
        """Return the values and their derivatives; the sign of a described Coulomb friction counts as constant."""
        n, samples, m = q.shape[1], len(q), self._finite.size
        slopes = tuple(np.zeros((samples, len(self._models) * m, n)) for _ in range(3))
        empty = np.zeros((max(self._plan.n_rows, 1), samples))
        for place, model in enumerate(self._models):
            for column, k in enumerate(self._finite):
                loads = np.zeros((samples, n))
                loads[:, k] = 1.0 / self._limit[k]
                found = regressor_adjoint(self._plan, q, qd, qdd, empty, loads, model.parameters)
                for slope, part in zip(slopes, found, strict=True):
                    slope[:, place * m + column] = part
        if self._drive:
            step = 1e-6
            rigid = np.zeros_like(q)
            for order, away in ((1, qd), (2, qdd)):
                up, down = [q, qd, qdd], [q, qd, qdd]
                up[order], down[order] = away + step, away - step
                slope = (self._friction(up[0], up[1], up[2], rigid) - self._friction(down[0], down[1], down[2], rigid)) / (2 * step)
                for column, k in enumerate(self._finite):
                    for place in range(len(self._models)):
                        slopes[order][:, place * m + column, k] += slope[:, k] / self._limit[k]
        return Linearised(self.values(q, qd, qdd), (slopes[0], slopes[1], slopes[2]), True)

    def _friction(self, q: Array, qd: Array, qdd: Array, load: Array) -> Array:
        if not self._drive:
            return np.zeros_like(q)
        sign = np.tanh(qd / SIGN_WIDTH)
        away = np.abs(qd) + 1e-12
        ahead = drive_torque(self._drive, self._values, q, away, qdd, load=load)
        behind = drive_torque(self._drive, self._values, q, -away, qdd, load=load)
        mixed: Array = 0.5 * ((1 + sign) * ahead + (1 - sign) * behind)
        return mixed


class PowerLimit(StateConstraint):
    """Keep the mechanical power `|tau qd| / limit` of every joint below 1."""

    name = "power"
    two_sided = True

    def __init__(self, model: RobotModel, limit: Array) -> None:
        self._finite = np.flatnonzero(np.isfinite(limit))
        self._torque = TorqueLimit((model,), limit)

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the power over its limit, (N, limited joints)."""
        power: Array = self._torque.values(q, qd, qdd) * qd[:, self._finite]
        return power

    def linearised(self, q: Array, qd: Array, qdd: Array) -> Linearised:
        """Return the values and their derivatives by the product rule."""
        torque, speed = self._torque.linearised(q, qd, qdd), qd[:, self._finite]
        by_state = [np.zeros(speed.shape) if slope is None else slope * speed[:, :, None] for slope in torque.by_state]
        for column, k in enumerate(self._finite):
            by_state[1][:, column, k] += torque.values[:, column]
        return Linearised(torque.values * speed, (by_state[0], by_state[1], by_state[2]), True)


def perturbed_models(model: RobotModel, count: int, spread: float, rng: np.random.Generator) -> tuple[RobotModel, ...]:
    """Return the model and `count` versions with masses and inertias off by `spread` (standard deviation, as a fraction), centres of mass likewise."""
    versions = [model]
    for _ in range(count):
        links = []
        for link in model.links:
            mass, inertia = np.exp(spread * rng.normal(size=2))
            values = link.inertia.parameters.copy()
            values[:6] *= inertia * mass
            values[6:9] *= mass * (1 + spread * rng.normal(size=3))
            values[9] *= mass
            links.append(replace(link, inertia=LinkInertia(values), parts=()))
        versions.append(replace(model, links=tuple(links)))
    return tuple(versions)
