"""Checked request for a program."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation.collision.clearance import Clearance
from asbuilt.excitation.limits import LimitReport, MotionBounds, check_motion
from asbuilt.excitation.motions.motion import Motion, read_only
from asbuilt.writers.programs.naming import file_stem

DRY_RUN_SLOWDOWN = 10.0
"""Factor of the dry run's duration: 10 % of the speed, 1 % of the acceleration."""

REST = 1e-3
"""Speed relative to the top speed below which a motion is at rest at its ends."""


@dataclass(frozen=True)
class Approach:
    """Limits of the approach to the start pose; revolute joints first, then prismatic ones.

    | field | meaning and source |
    |---|---|
    | `speed` | top speed [rad/s, m/s]; below the 250 mm/s of ISO 10218 at 1.25 m |
    | `fraction` | largest share of a joint's velocity limit |
    | `tolerance` | deviation from the start pose with which the motion may begin [rad, m] |
    """

    speed: tuple[float, float] = (0.2, 0.05)
    fraction: float = 0.2
    tolerance: tuple[float, float] = (0.01, 0.002)


APPROACH = Approach()


@dataclass(frozen=True, eq=False, repr=False)
class ProgramRequest:
    """Request a program that moves `model` along `motion`, sampled at `rate` [Hz].

    `name` is free text; `clearance` is the smallest distance between bodies, None if unchecked.

    Raises
    ------
    MotionError
        If the motion or its dry run violates a limit, or does not start and end at rest.
    """

    model: RobotModel
    motion: Motion
    name: str
    rate: float
    clearance: Clearance | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise MotionError(
                f"the rate of a program must be a positive number of Hz, got {self.rate:g}"
            )
        self.report.raise_if_violated()
        try:
            # Rate at which the slow dry run is compared with the limits [Hz].
            check_motion(self.model, self.dry_run, 100.0).raise_if_violated()
        except MotionError as error:
            raise MotionError(
                f"the dry run at {100 / DRY_RUN_SLOWDOWN:g} % speed violates a limit: {error}"
            ) from None
        top = self.motion.peaks(1)
        for where, time in (("start", 0.0), ("end", self.motion.duration)):
            speed = np.abs(self.motion.derivative(time, 1))
            j = int(np.argmax(speed - REST * top))
            if speed[j] > REST * top[j] + 1e-9:
                raise MotionError(
                    f"joint {self.model.joint_names[j]} moves at {speed[j]:g} (rad or m)/s at the"
                    f" {where} of the motion, where a controller needs it at rest; use a motion"
                    " that starts and ends at rest (FourierMotion, BSplineMotion, QuinticMotion)",
                    joint=self.model.joint_names[j],
                    value=float(speed[j]),
                )

    def __repr__(self) -> str:
        return f"ProgramRequest({self.model.name!r}, {self.name!r}, {self.motion.duration:g} s)"

    @cached_property
    def report(self) -> LimitReport:
        """Margins to the limits on a 1 kHz grid."""
        return check_motion(self.model, self.motion)

    @cached_property
    def dry_run(self) -> Motion:
        """The same path at the speed of the dry run."""
        return self.motion.slowed(DRY_RUN_SLOWDOWN)

    @property
    def stem(self) -> str:
        """The name of the files, without suffix."""
        return file_stem(self.name)

    @property
    def revolute(self) -> tuple[bool, ...]:
        """Whether each joint is revolute."""
        return tuple(joint.is_revolute for joint in self.model.joints)

    @property
    def approach_speed(self) -> Array:
        """Top speed of each joint on the approach to the start pose (n,) [rad/s or m/s]."""
        slow = np.where(self.revolute, *APPROACH.speed)
        return read_only(np.minimum(slow, APPROACH.fraction * MotionBounds.of(self.model).velocity))

    @property
    def start_tolerance(self) -> Array:
        """Allowed deviation of each joint from the start pose (n,) [rad or m]."""
        return np.where(self.revolute, *APPROACH.tolerance)

    @property
    def period_ms(self) -> int:
        """Sampling period in whole milliseconds, for KUKA; raises `MotionError` otherwise."""
        period = round(1000.0 / self.rate)
        if period < 1 or abs(period * self.rate - 1000.0) > 1e-6:
            raise MotionError(
                f"{self.rate:g} Hz is not a period of whole milliseconds, which the controller"
                " needs; choose 1000, 500, 250, 200, 125 or 100 Hz"
            )
        return period
