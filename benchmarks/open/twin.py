"""The twin of a log of legs: the same description, motion and contacts, bodies that are known.

Torques are those that Pinocchio gives for bodies and drives drawn from a seed: the base is driven
by the feet alone, so its acceleration becomes the nearest at which they can. Torques are logged
with errors of which a part comes again in every cycle of the gait, as what fits to the recorded
log leave does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from flyer import BASE, contact_rows
from pinocchio_regressor import FROM_PINOCCHIO
from plain import Motion, low_pass

from asbuilt.description.model import RobotModel

sys.path.append(str(Path(__file__).resolve().parents[1]))
from outside_robot import other_bodies

Array = Any
OFF = 0.14
"""How far bodies are off the description, as a part of what `other_bodies` draws: with it the
description scores 2 %, as it does on the recorded log."""
COULOMB, VISCOUS, ARMATURE = 0.005, 5e-4, 2e-5
"""Largest friction [N m, N m s/rad] and rotor [kg m^2] of a joint, drawn evenly from zero: what
consistent fits find in the recorded log, where rotors are hardly seen."""
ERROR = 0.012
"""Root mean square of the error of a joint's torque over that of the torque: with it the truth
scores what consistent fits score on the recorded log."""
REPEATED = 0.6
"""Part of the error's power that comes again in every cycle: of what the consistent fit to the
recorded log leaves, the mean over other cycles foretells 58 %."""
CYCLE = 0.5
"""Seconds of a cycle of the gait."""
FASTEST = 20.0
"""Frequency [Hz] up to which the error goes: that of the score."""


@dataclass(frozen=True)
class Twin:
    """A robot with a free base: bodies (n_links, 10) and drives (n,) each."""

    bodies: Array
    coulomb: Array
    viscous: Array
    armature: Array
    offset: Array

    @classmethod
    def draw(cls, described: RobotModel, n: int, rng: np.random.Generator) -> Twin:
        """Return a robot from a seed, near its description."""
        near, far = (
            np.array([x.inertia.parameters for x in model.links if x.inertia.mass > 0.0])
            for model in (described, other_bodies(described, rng))
        )
        return cls(
            near + OFF * (far - near),  # a mean of bodies that can exist can exist
            rng.uniform(0.0, COULOMB, n),
            rng.uniform(0.0, VISCOUS, n),
            rng.uniform(0.0, ARMATURE, n),
            rng.normal(scale=COULOMB, size=n),
        )

    def drives(self, qd: Array, qdd: Array) -> Array:
        """Return the torque (N, n) of friction and rotors."""
        rubbing = self.viscous * qd + self.coulomb * np.sign(qd) + self.offset
        return np.asarray(rubbing + self.armature * qdd)

    def built(self, model: Any) -> Any:
        """Return Pinocchio's model with the bodies of this robot."""
        model = model.copy()
        for k, row in enumerate(self.bodies):
            own = np.empty(10)
            own[FROM_PINOCCHIO] = row
            model.inertias[k + 1] = pin.Inertia.FromDynamicParameters(own)
        return model

    def at_states(self, model: Any, states: Motion) -> Array:
        """Return the torque (N, 6 + n) of bodies and drives in states, forces of feet aside."""
        model = self.built(model)
        data = model.createData()
        moved = zip(*states[1:4], strict=True)
        torque = np.array([pin.rnea(model, data, *each) for each in moved])
        torque[:, BASE:] += self.drives(states.qd[:, BASE:], states.qdd[:, BASE:])
        return torque

    def torque(
        self, model: Any, log: dict[str, Array], feet: list[str], radius: float
    ) -> tuple[Array, Array]:
        """Return accelerations (N, 6 + n) that the feet allow and the torque (N, n) of them."""
        model = self.built(model)
        data, frames = model.createData(), [model.getFrameId(name) for name in feet]
        qdd, tau = np.array(log["qdd"]), np.empty((len(log["t"]), model.nv - BASE))
        for i, (q, qd, closed) in enumerate(zip(log["q"], log["qd"], log["contact"], strict=True)):
            J = contact_rows(model, data, q, frames, closed, radius)
            M = pin.crba(model, data, q)[:BASE, :BASE]
            load = pin.rnea(model, data, q, qd, qdd[i])
            free = unreached(J[:, :BASE].T)
            step = -free @ np.linalg.solve(free.T @ M @ free, free.T @ load[:BASE])
            qdd[i, :BASE] += step
            load = pin.rnea(model, data, q, qd, qdd[i])
            force = np.linalg.pinv(J[:, :BASE].T) @ load[:BASE]
            tau[i] = load[BASE:] - J[:, BASE:].T @ force
        return qdd, tau + self.drives(log["qd"][:, BASE:], qdd[:, BASE:])


def twin_log(
    model: RobotModel, log: dict[str, Array], source: Path, settings: dict[str, Any]
) -> tuple[dict[str, Array], Callable[[Motion], Array]]:
    """Return the log of a robot drawn from the seed, and its true torques in states."""
    rng = np.random.default_rng([2027, settings["seed"]])
    robot = Twin.draw(model, log["tau"].shape[1], rng)
    flyer = pin.buildModelFromUrdf(str(source), pin.JointModelFreeFlyer())
    qdd, tau = robot.torque(flyer, log, settings["contacts"], settings["radius"])
    logged = tau + errors(log["t"], tau, rng)
    return log | {"qdd": qdd, "tau": logged}, lambda states: robot.at_states(flyer, states)


def unreached(A: Array) -> Array:
    """Return a basis (6, k) of the wrenches that no force of the feet gives."""
    U, s, _ = np.linalg.svd(A)
    rank = int(np.sum(s > 1e-9 * max(s[0], 1e-12)))
    return U[:, rank:]


def errors(t: Array, tau: Array, rng: np.random.Generator) -> Array:
    """Return errors (N, n) of a logged torque: a part repeats with the gait, the rest does not."""
    n, rate = tau.shape[1], 1.0 / np.median(np.diff(t))
    orders = np.arange(1, round(FASTEST * CYCLE) + 1)
    turning = 2.0 * np.pi * np.outer(t / CYCLE, orders)
    waves = np.hstack([np.cos(turning), np.sin(turning)])
    again = waves @ rng.normal(scale=1.0 / np.sqrt(len(orders)), size=(waves.shape[1], n))
    once = low_pass(rng.normal(size=(len(t), n)), rate, FASTEST)
    once /= np.sqrt(np.mean(once**2))
    size = ERROR * np.sqrt(np.mean(tau**2, axis=0))
    return np.asarray(size * (np.sqrt(REPEATED) * again + np.sqrt(1.0 - REPEATED) * once))
