"""Errors of the log: its clock, zero positions, gains, and what drifts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect

ANGLE, LENGTH, SPEED = 1e-4, 1e-5, 1e-3
"""Steps of central differences: angle [rad], length [m], share of the speed."""


class _AtEveryJoint(Effect):
    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the effect at every joint."""
        yield Variant(self, 1, local=True, joints=tuple(range(robot.model.n_joints)))


@effect
class Clock(Effect):
    """Run the motion faster than logged by a share."""

    key, title, of_log = "clock", "wrong clock", True
    least = 0.01

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the clock of the log."""
        yield Variant(self, 1, local=False)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the derivative of the torque by the logarithm of the clock's rate."""
        up, down = (
            motion.torque_of(motion.q, motion.qd * f, motion.qdd * f**2)[1]
            for f in (1.0 + SPEED, 1.0 - SPEED)
        )
        return [(up - down) / (2.0 * SPEED)]


@effect
class Zero(Effect):
    """Log the positions of a joint too large [rad or m]."""

    key, title, of_log = "zero", "wrong zero position", True
    least = 0.005
    """A third of a degree, or 5 mm."""

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the zero position of each joint."""
        for k in range(robot.model.n_joints):
            yield Variant(self, 1, local=False, joint=k)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return minus the derivative of the torque by the position of the joint."""
        k, step = variant.joint or 0, np.zeros(motion.q.shape[1])
        step[k] = ANGLE if motion.robot.model.joints[k].is_revolute else LENGTH
        up, down = (
            motion.torque_of(x, motion.qd, motion.qdd)[1]
            for x in (motion.q + step, motion.q - step)
        )
        return [(down - up) / (2.0 * step[k])]


@effect
class Gain(_AtEveryJoint):
    """Log the torques of a joint too large by a share."""

    key, title, of_log = "gain", "wrong torque gain", True
    least = 0.03
    """Accuracy of the gains that makers state."""

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torque of the model."""
        return [motion.torques[1]]


@effect
class Drift(_AtEveryJoint):
    """Let the torque offset drift over the recording [N m or N]."""

    key, title, of_log = "drift", "drift of the torque offset", True

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the share of the recording that has passed."""
        return [np.repeat(motion.elapsed[:, None], motion.q.shape[1], axis=1)]


@effect
class Warming(_AtEveryJoint):
    """Let the drive's torque change by a share over the recording."""

    key, title = "warming", "drift of friction"

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torque of the drive times the share of the recording that has passed."""
        rigid, torque = motion.torques
        return [motion.elapsed[:, None] * (torque - rigid)]
