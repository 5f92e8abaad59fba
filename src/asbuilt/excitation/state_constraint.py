"""Constraints on the joint state at one instant, such as the torque limit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import LinkInertia, RobotModel
from asbuilt.dynamics import described_drive, drive_torque, inverse_dynamics
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.regressor import RegressorPlan

STANDING = 0.9
"""Share of the allowed torque that a robot at rest may need; the rest accelerates it."""
STEP = 1e-6
"""Step of the central differences through described friction."""


class StateConstraint(ABC):
    """Bound a function of the joint state at one instant: torque, distance, place of the tool.

    Its values are normalised: they must stay below 1, and above -1 if `two_sided`.
    """

    name: str
    two_sided: bool

    @abstractmethod
    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the normalised values (N, m) at the states (N, n)."""

    @abstractmethod
    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivatives of the values (N, m, n, r) by position and time derivatives.

        `r` orders are given: 1 for position alone, 3 up to acceleration.
        """

    def smallest_distance(self, q: Array) -> float | None:
        """Return the smallest distance between bodies over poses (N, n) [m], None if unchecked."""
        return None

    def notes(self, q: Array, qd: Array, qdd: Array) -> tuple[str, ...]:
        """Return sentences about how the states (N, n) keep the constraint."""
        return ()


def smallest_distance(constraints: Sequence[StateConstraint], q: Array) -> float | None:
    """Return the smallest distance between bodies that any of the constraints checks [m]."""
    found = (constraint.smallest_distance(q) for constraint in constraints)
    return min((distance for distance in found if distance is not None), default=None)


class TorqueLimit(StateConstraint):
    """Keep `|tau| / limit` below 1 for every given description, drive values included."""

    name = "torque"
    two_sided = True

    def __init__(self, models: Sequence[RobotModel], limit: Array) -> None:
        self._model = models[0]
        self._parameters = np.stack([model.parameters for model in models])
        self._plan = RegressorPlan.of(self._model)
        self._limit = limit
        self._finite = np.flatnonzero(np.isfinite(limit))
        self._drive, values = described_drive(self._model)
        self._exact_friction = partial(
            drive_torque, self._drive, values, shares=self._model.motor_shares
        )

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque over its limit, (N, models x limited joints)."""
        torque = self._evaluate_rigid(q, qd, qdd)
        if self._drive:
            torque = torque + np.stack(
                [self._evaluate_friction(q, qd, qdd, load) for load in self._list_loads(torque)],
                axis=1,
            )
        return (torque / self._limit)[:, :, self._finite].reshape(len(q), -1)

    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivatives of the values, (N, models x limited joints, n, 3).

        Central differences give the derivatives of described friction.
        """
        slopes = torque_derivatives(self._model, q, qd, qdd, self._parameters)
        if self._drive:
            through = [
                self._differentiate_friction(q, qd, qdd, load)
                for load in self._list_loads(self._evaluate_rigid(q, qd, qdd))
            ]
            by_load = np.stack([slope[..., 3] for slope in through], axis=1)
            slopes = (
                slopes
                + np.einsum("smkj,smjxo->smkxo", by_load, slopes)
                + np.stack([slope[..., :3] for slope in through], axis=1)
            )
        limited: Array = slopes[:, :, self._finite] / self._limit[self._finite, None, None]
        return limited.reshape(len(q), -1, *limited.shape[3:])

    def _list_loads(self, torque: Array) -> list[Array]:
        """Return the loads of the friction: one for every description, or one for all."""
        return [
            torque[:, place] for place in range(torque.shape[1] if self._drive.needs_load else 1)
        ]

    def _evaluate_rigid(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque of the rigid bodies of every description, (N, models, n)."""
        if len(self._parameters) == 1:
            return inverse_dynamics(self._model, q, qd, qdd, threads=1)[:, None]
        rows = self._plan.evaluate(q, qd, qdd)
        return np.stack(
            [
                row.T @ self._parameters[:, support].T
                for row, support in zip(rows, self._plan.support, strict=True)
            ],
            axis=2,
        )

    def _differentiate_friction(self, *state: Array) -> Array:
        """Return the derivatives of friction k by q, qd, qdd and load of joint j, (N, k, j, 4)."""
        n = state[0].shape[1]
        coupled = bool(self._drive.of_motor.any())
        ways = (
            [(way, np.tile(way, (n, 1))) for way in np.eye(n)]
            if coupled
            else [(np.ones(n), np.eye(n))]
        )
        found = np.zeros((len(state[0]), n, n, len(state)))
        for way, pattern in ways:
            for order in range(len(state) if self._drive.needs_load else 3):
                up, down = (
                    [x + step * way if i == order else x for i, x in enumerate(state)]
                    for step in (STEP, -STEP)
                )
                slope = (self._evaluate_friction(*up) - self._evaluate_friction(*down)) / (2 * STEP)
                found[..., order] += slope[:, :, None] * pattern
        return found

    def _evaluate_friction(self, q: Array, qd: Array, qdd: Array, load: Array) -> Array:
        if self._drive.of_motor.any():
            return self._exact_friction(q, qd, qdd, load=load)
        # Width over which the sign in described friction is smoothed for derivatives [rad/s or
        # m/s].
        sign = np.tanh(qd / 0.02)
        away = np.abs(qd) + 1e-12
        ahead = self._exact_friction(q, away, qdd, load=load)
        behind = self._exact_friction(q, -away, qdd, load=load)
        return np.asarray(0.5 * ((1 + sign) * ahead + (1 - sign) * behind))


class WeightLimit(TorqueLimit):
    """Keep the torque at rest within the limit, so that the robot can move at any low speed."""

    name = "weight"

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque at rest over its limit, (N, models x limited joints)."""
        return super().values(q, np.zeros_like(q), np.zeros_like(q))

    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivatives of the values by q, (N, models x limited joints, n, 1)."""
        return super().slopes(q, np.zeros_like(q), np.zeros_like(q))[..., :1]

    def binds(self, poses: Array) -> bool:
        """Return whether the robot is too heavy in any of the poses (N, n)."""
        return bool(np.any(np.abs(self.values(poses, poses, poses)) >= 1))


class PowerLimit(StateConstraint):
    """Keep the mechanical power `|tau qd| / limit` of every joint below 1."""

    name = "power"
    two_sided = True

    def __init__(self, model: RobotModel, limit: Array) -> None:
        self._joint_names = model.joint_names
        self._limit = limit
        self._finite = np.flatnonzero(np.isfinite(limit))
        self._torque = TorqueLimit((model,), limit)

    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the power over its limit, (N, limited joints)."""
        return np.asarray(self._torque.values(q, qd, qdd) * qd[:, self._finite])

    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivatives of the values by the product rule, (N, limited joints, n, 3)."""
        slopes = self._torque.slopes(q, qd, qdd) * qd[:, self._finite, None, None]
        slopes[:, np.arange(self._finite.size), self._finite, 1] += self._torque.values(q, qd, qdd)
        return slopes

    def notes(self, q: Array, qd: Array, qdd: Array) -> tuple[str, ...]:
        """State the largest power relative to its limit."""
        used = np.abs(self.values(q, qd, qdd)).max(axis=0)
        k = int(np.argmax(used))
        joint = self._finite[k]
        limit = self._limit[self._finite[k]]
        return (
            f"power at most {used[k] * limit:.3g} W of the {limit:g} W allowed, by"
            f" {self._joint_names[joint]}",
        )


def perturb_models(
    model: RobotModel, count: int, spread: float, rng: np.random.Generator
) -> tuple[RobotModel, ...]:
    """Return the model and `count` versions with random mass properties.

    Masses, inertias and centres of mass are off by `spread` (standard deviation, as a fraction).
    """
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
