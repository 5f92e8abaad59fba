"""Smallest distance between bodies along a motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation.collision.capsules import surroundings
from asbuilt.excitation.collision.constraint import CollisionGuard
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.pacing import CHECK_RATE
from asbuilt.findings import Cure

POSES_AT_ONCE = 4000
"""Poses evaluated together, for memory."""


@dataclass(frozen=True)
class Clearance:
    """Smallest `distance` [m] between the bodies of `source` along a motion.

    `obstacles` are those beside the robot, `left_out` pairs that always touch.
    """

    source: str
    distance: float
    obstacles: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def clearance_along(model: RobotModel, motion: Motion, source: str) -> Clearance:
    """Return the smallest distance on a 1 kHz grid between the bodies of `source`.

    Raises
    ------
    MotionError
        If bodies of pairs that are checked touch.
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
            f"bodies of {source} overlap by {-1000 * distance:.0f} mm between t = {part[0]:.2f} and"
            f" {part[-1]:.2f} s of the motion",
            cure=Cure("design a motion that keeps them apart", {"collision": source}),
            distance=distance,
        )
    return Clearance(
        source, distance, tuple(obstacle.name for obstacle in bodies.obstacles), guard.left_out
    )
