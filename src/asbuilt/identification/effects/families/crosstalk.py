"""Torque sensors that answer to the torque of other joints, too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure, Finding
from asbuilt.identification.effects.effect import (
    Described,
    Effect,
    FoundEffect,
    Motion,
    Variant,
    effect,
)
from asbuilt.tables import format_plus_minus

SENSED = ("sensor", "unknown")
"""Torque sources that may be a sensor: a motor's current has no other joint's in it."""
SURE_PART = 3.0
"""Standard errors from which on a joint is named whose torque a sensor adds."""


@effect
class CrossTalk(Effect):
    """Add to a joint's logged torque a share of each other joint's.

    The log then has `(I + C) tau` with a zero diagonal of C: a row of C is the effect at its joint,
    columns are the torques of the other joints in their order.
    """

    key = "crosstalk"
    title = "sensor cross-talk"
    of_log = True
    of_shares = True
    least = 0.005
    """Cross-talk that makers of sensors state."""
    farthest = 0.3

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the row of each joint of a robot that may have torque sensors."""
        n = robot.model.n_joints
        if n > 1 and robot.source in SENSED:
            yield Variant(self, n - 1, local=True, joints=tuple(range(n)))

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torques of the joints that follow, in a circle."""
        torque = motion.torques[1]
        return [np.roll(torque, -step, axis=1) for step in range(1, torque.shape[1])]

    def name_parts(self, joint_names: Sequence[str], joint: int | None) -> tuple[str, ...]:
        """Return the joints whose torques the sensor of a joint (from 0) adds, by value."""
        k = joint or 0
        return (*joint_names[k + 1 :], *joint_names[:k])

    def part_text(self, name: str, value: float, error: float) -> str:
        """Return one entry of the row as text, empty where it may be none."""
        if abs(value) < max(SURE_PART * error, 0.1 * self.least):
            return ""
        return f"{format_plus_minus(100.0 * value, 100.0 * error)} % of {name}"

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return which torques a sensor adds."""
        # The entries of the row stand in brackets; without a sure one its length is all there is.
        listed = found.text.partition("(")[2].rpartition(")")[0]
        error = None if found.std_error is None else 100.0 * found.std_error
        whole = f"{format_plus_minus(100.0 * found.estimate, error)} % of other joints"
        return Finding(
            "sensor_crosstalk",
            "warning",
            f"The torque of {found.joint} holds {listed or whole} in addition to its own"
            f" ({found.improvement}), as of sensors that answer to other joints' torques",
            Cure(
                "take these shares off the logged torque, or calibrate the sensors against each"
                " other; the gain of the joint is no cure"
            ),
            joint=found.joint,
        )
