"""Standard errors of an identified position servo, and what they rest on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from asbuilt.codec import store_as


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoErrors:
    """Hold what is known of the errors of a servo.

    Parameters
    ----------
    kp
        Standard errors of the stiffness (n,), 0 where it was given, infinite where nothing
        determines it.
    delay
        Standard error of the delay [s], 0 where it was given.
    lead
        Standard error of the lead [s], 0 where it was given or none was searched.
    goal_acceleration
        Standard error of the limit of the goal's acceleration [rad/s^2 or m/s^2], 0 where it was
        given or not found in every recording.
    goal_sought
        Whether the limit of each joint was searched in the recordings.
    deadband
        Standard error of the deadband [rad or m], 0 where it was given or none was found.
    shared
        Whether one stiffness was fitted to all joints.
    scale
        What gives the stiffness of each joint its scale: gravity or inertia of CAD, or "given".
    kd_unknown
        Whether the damping of each joint is unknown and part of its viscous friction.
    """

    kp: tuple[float, ...] = field(default=(), metadata=store_as(missing=np.inf))
    delay: float = 0.0
    lead: float = 0.0
    goal_acceleration: float = 0.0
    goal_sought: tuple[bool, ...] = ()
    deadband: float = 0.0
    shared: bool = False
    scale: tuple[str, ...] = ()
    kd_unknown: tuple[bool, ...] = ()
