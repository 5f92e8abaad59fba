"""Motors that turn with the joint before their own, too."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect


@effect
class Coupling(Effect):
    """Let the motor of joint k turn with joint k - 1, `s = q_k + share q_(k-1)`.

    Its armature and viscous friction then act across both joints: `share Ia q''_(k-1)` at joint k
    and `share Ia q''_k` at joint k - 1, the same of friction. What acts on one joint alone is in
    the model's own terms.
    """

    key = "coupling"
    title = "coupled motor"
    units = ("kg m^2", "kg")
    imitators = ("friction",)
    """Coulomb friction changes its sign with the motor's speed, which is no joint's."""

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield each pair of neighbours that turn."""
        joints = robot.model.joints
        for k in range(1, robot.model.n_joints):
            # A prismatic neighbour would mix units, and no such drive is built.
            if joints[k].is_revolute and joints[k - 1].is_revolute:
                yield Variant(self, 2, local=False, joint=k)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return acceleration and velocity of each of both joints at the other one."""
        # Variants start at joint 1: `or` is for the type alone.
        k = variant.joint or 1
        return [_swap_neighbour(values, k) for values in (motion.qdd, motion.qd)]


def _swap_neighbour(values: Array, k: int) -> Array:
    column = np.zeros_like(values)
    # By virtual work the share acts both ways: each joint gets the other one's motion.
    column[:, k] = values[:, k - 1]
    column[:, k - 1] = values[:, k]
    return column
