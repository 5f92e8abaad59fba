"""How near the bodies of a robot come to each other and to obstacles along a motion, as far as
anybody has described them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation.collision.capsules import surroundings
from asbuilt.excitation.collision.constraint import CollisionGuard
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.pacing import CHECK_RATE

POSES_AT_ONCE = 4000
"""Poses that are looked at together, for memory."""


@dataclass(frozen=True)
class Clearance:
    """Say that the bodies of `source` come no nearer than `distance` [m] along a motion.

    `obstacles` are those beside the robot, `left_out` pairs that always touch.
    """

    source: str
    distance: float
    obstacles: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def clearance_along(model: RobotModel, motion: Motion, source: str) -> Clearance:
    """Return how near bodies come on a 1 kHz grid.

    `source` is what `--collision` takes, see `surroundings`.

    Raises
    ------
    MotionError
        If they touch, with bodies that meet only by accident.
    """
    bodies = surroundings(model, source)
    guard = CollisionGuard(model, bodies)
    t = np.linspace(0.0, motion.duration, int(np.ceil(motion.duration * CHECK_RATE)) + 1)
    nearest = [
        guard.smallest_distance(motion.derivative(part))
        for part in np.array_split(t, max(1, len(t) // POSES_AT_ONCE))
    ]
    distance = min(nearest)
    if distance <= 0.0:
        part = np.array_split(t, max(1, len(t) // POSES_AT_ONCE))[int(np.argmin(nearest))]
        raise MotionError(
            f"bodies of {source} run into each other by {-1000 * distance:.0f} mm between t ="
            f" {part[0]:.2f} and {part[-1]:.2f} s of the motion; design it with --collision"
            f" {source}"
        )
    return Clearance(
        source, distance, tuple(obstacle.name for obstacle in bodies.obstacles), guard.left_out
    )
