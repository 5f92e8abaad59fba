"""What a refinement fits of a position servo: a common factor of its stiffness, delay and lead."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.dynamics.drives.position_servo import PositionServo

TIME_SCALE = 1e-3
"""Unit of delay and lead in the coordinates [s]."""
STIFFNESS_SPREAD = 1.0
"""Prior standard deviation of the logarithm of a common stiffness that nothing determines."""
TIME_SPREAD = 20.0
"""Prior standard deviation of delay and lead, in units of `TIME_SCALE`."""


@dataclass(frozen=True, slots=True)
class ServoCoordinates:
    """Say what is fitted of a servo, and how coordinates change it.

    The coordinates are, as far as they are free, the logarithm of a common factor of all
    stiffnesses, the delay, and a common addition to the leads. A lead is estimated if the torque
    seems to precede its command: a derivative gain advances it, and the delay itself, which causes
    nothing before the command, stays at or above zero.

    Parameters
    ----------
    stiffness, delay, lead
        What is free.
    spread
        Standard deviation of the logarithm of a common stiffness before the trajectories.
    """

    stiffness: bool = False
    delay: bool = False
    lead: bool = False
    spread: float = STIFFNESS_SPREAD

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        free = (("stiffness", self.stiffness), ("delay", self.delay), ("lead", self.lead))
        return tuple(name for name, there in free if there)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.names)

    @property
    def weights(self) -> Array:
        """Weights of the squared coordinates from the start (size,)."""
        spreads = {"stiffness": self.spread, "delay": TIME_SPREAD, "lead": TIME_SPREAD}
        return np.array([spreads[name] ** -2.0 for name in self.names])

    def columns(self, servo: PositionServo) -> Array:
        """Return how kp and kd of each joint, delay and lead follow, (2 n + 2, size)."""
        n = len(servo.kp)
        found = np.zeros((2 * n + 2, self.size))
        for column, name in enumerate(self.names):
            if name == "stiffness":
                found[:n, column] = servo.kp
            else:
                found[2 * n + (name == "lead"), column] = TIME_SCALE
        return found

    def moved(self, servo: PositionServo, step: Array) -> PositionServo:
        """Return the servo at coordinates `step` (size,) from a servo."""
        by = dict(zip(self.names, step.tolist(), strict=True))
        if "stiffness" in by:
            factor = float(np.exp(by["stiffness"]))
            servo = replace(servo, kp=tuple(factor * x for x in servo.kp))
        if "delay" in by:
            late = (servo.delay or 0.0) + TIME_SCALE * by["delay"]
            servo = replace(servo, delay=max(late, 0.0) if self.lead else late)
        if "lead" in by:
            leads = np.maximum(servo.leads + TIME_SCALE * by["lead"], 0.0)
            servo = replace(servo, lead=tuple(leads.tolist()))
        return servo

    def away(self, servo: PositionServo, start: PositionServo) -> Array:
        """Return the coordinates (size,) of a servo from another."""
        distance = {
            "stiffness": np.log(max(servo.kp) / max(start.kp)),
            "delay": ((servo.delay or 0.0) - (start.delay or 0.0)) / TIME_SCALE,
            "lead": float(np.mean(servo.leads - start.leads)) / TIME_SCALE,
        }
        return np.array([distance[name] for name in self.names])

    def at_bound(self, servo: PositionServo, gradient: Array) -> Mask:
        """Return which coordinates (size,) lie at their bound with the descent beyond it."""
        low = {
            "stiffness": False,
            "delay": self.lead and not (servo.delay or 0.0) > 0.0,
            "lead": not np.any(servo.leads > 0.0),
        }
        return np.array([low[name] for name in self.names], dtype=np.bool_) & (gradient > 0.0)
