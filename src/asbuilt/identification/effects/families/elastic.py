"""Elastic joints: links that lag behind their motors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.drives.elastic_columns import elastic_columns
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect


@effect
class Elastic(Effect):
    """Let the link of a joint lag by the torque over the joint's stiffness; its size is 1 / K."""

    key, title, positive = "elastic", "elastic joint, compliance", True

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
