"""Elastic joints: links that lag behind their motors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import mass_matrix
from asbuilt.excitation.limits import MotionBounds
from asbuilt.findings import Cure, Finding
from asbuilt.identification.drives.elastic_columns import elastic_columns
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect
from asbuilt.identification.effects.found_effect import FoundEffect
from asbuilt.tables import significant

POSTURES = 50
"""Postures over which the inertia behind a joint is averaged."""
OFF = 0.1
"""Share of a link's torque by which the rigid model is off at the frequency that is named."""


@effect
class Elastic(Effect):
    """Let the link of a joint lag by the torque over the joint's stiffness; its size is 1 / K."""

    key, title, positive, by_span = "elastic", "elastic joint, compliance", True, True

    def unit(self, revolute: bool) -> str:
        """Return the unit of a compliance."""
        return "rad/(N m)" if revolute else "m/N"

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield each joint."""
        for k in range(robot.model.n_joints):
            yield Variant(self, 1, local=False, joint=k)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torque per compliance of the joint."""
        state = np.stack([motion.q, motion.qd, motion.qdd])
        return [
            elastic_columns(
                motion.robot.model,
                motion.robot.chi,
                state,
                motion.rate,
                variant.joint or 0,
                load=motion.torques[0],
            )
        ]

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding | None:
        """Return the stiffness, and from which frequency on the rigid model fails."""
        if found.joint is None or not found.estimate > 0.0:
            return None
        k, stiffness = model.joint_names.index(found.joint), 1.0 / found.estimate
        limit = rigid_limit(model, k, stiffness)
        fails = f", so the rigid model is {100 * OFF:.0f} % off from {significant(limit, 2)} Hz on"
        unit = "N m/rad" if model.joints[k].is_revolute else "N/m"
        return Finding(
            "elastic_joint",
            "info",
            f"Not in the model: {found.joint} is elastic, about {significant(stiffness, 2)} {unit}"
            f"{fails if np.isfinite(limit) else ''}",
            Cure("log a second encoder (q_link_*), which shows the stiffness, or move slower"),
            joint=found.joint,
        )


def rigid_limit(model: RobotModel, joint: int, stiffness: float) -> float:
    """Return the frequency [Hz] from which the rigid model of an elastic joint fails.

    A link of inertia M on a spring K whose other end moves at the frequency w accelerates by
    `1 / (1 - w^2 M / K)` as much: to first order its torque is the share `w^2 M / K` off. M is the
    mean over the joint's range of the description's masses, infinite where they are none.
    """
    bounds = MotionBounds.assumed(model)
    rng = np.random.default_rng(0)
    q = rng.uniform(bounds.lower, bounds.upper, size=(POSTURES, model.n_joints))
    inertia = float(np.mean(mass_matrix(model, q)[:, joint, joint]))
    return float(np.sqrt(OFF * stiffness / inertia) / (2.0 * np.pi)) if inertia > 0.0 else np.inf
