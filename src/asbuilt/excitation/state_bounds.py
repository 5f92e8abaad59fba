"""State bounds of a robot, completed if the description lacks limits, and random states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.excitation.information.information import Information
from asbuilt.excitation.limits import MotionBounds

SCALING_STATES = 500
"""Random states over which the units of the parameters are averaged."""


def limited_model(model: RobotModel) -> tuple[RobotModel, tuple[str, ...]]:
    """Return the robot with complete limits, and the names of those that were assumed."""
    bounds = MotionBounds.assumed(model)
    assumed: list[str] = []
    limits = []
    for j, joint in enumerate(model.joints):
        completed = replace(
            joint.limits,
            lower=float(bounds.lower[j]),
            upper=float(bounds.upper[j]),
            velocity=float(bounds.velocity[j]),
            acceleration=float(bounds.acceleration[j]),
        )
        limits.append(completed)
        given = joint.limits
        known = {
            "position": np.isfinite(given.lower) and np.isfinite(given.upper),
            "velocity": np.isfinite(given.velocity),
            "acceleration": np.isfinite(given.acceleration),
        }
        assumed += [
            quantity for quantity, stated in known.items() if not stated and quantity not in assumed
        ]
    return model.with_limits(limits), tuple(assumed)


def random_states(
    bounds: MotionBounds, count: int, rng: np.random.Generator, *, extreme: float = 0.0
) -> tuple[Array, Array, Array]:
    """Return states (count, n), uniform within the bounds.

    Velocities and accelerations sit at a limit or at zero with probability `extreme`.
    """
    n = bounds.lower.size
    q = rng.uniform(bounds.lower, bounds.upper, size=(count, n))
    found = [q]
    for limit in (bounds.velocity, bounds.acceleration):
        inner, corner = (
            rng.uniform(-1, 1, size=(count, n)),
            rng.integers(-1, 2, size=(count, n)).astype(np.float64),
        )
        found.append(limit * np.where(rng.uniform(size=(count, n)) < extreme, corner, inner))
    return found[0], found[1], found[2]


def parameter_scale(information: Information, bounds: MotionBounds) -> Array:
    """Return the change of each base parameter (p,) that changes the torque by its noise.

    The change of torque is an RMS over the state bounds.
    """
    states = random_states(bounds, SCALING_STATES, np.random.default_rng(0))
    rows = information.rows(*states, smooth=False)
    size = np.diag(information.matrix(rows, SCALING_STATES)) / SCALING_STATES
    scale: Array = 1.0 / np.sqrt(np.maximum(size, 1e-12 * size.max()))
    return scale
