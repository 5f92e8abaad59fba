"""What a program is asked to do, checked before a line of it is written."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation.collision.clearance import Clearance
from asbuilt.excitation.limits import LimitReport, MotionBounds, check_motion
from asbuilt.excitation.motions.motion import JUMPING, Motion, read_only
from asbuilt.writers.programs.naming import file_stem

DRY_RUN_SLOWDOWN = 10.0
"""The dry run takes this many times as long: 10 % of the speed, 1 % of the acceleration."""

APPROACH_SPEED = {True: 0.2, False: 0.05}
"""Top speed on the way to the start pose, in rad/s (revolute) or m/s (prismatic)."""

APPROACH_FRACTION = 0.2
"""... and never more than this part of a joint's velocity limit."""

START_TOLERANCE = {True: 0.01, False: 0.002}
"""How far from the start pose a joint may be when the motion begins, in rad or m."""

REST = 1e-3
"""A motion is at rest at its ends when it moves slower than this part of its top speed there."""

DRY_RUN_CHECK_RATE = 100.0
"""Rate at which the slow dry run is checked against the limits [Hz]."""


@dataclass(frozen=True)
class ProgramFile:
    """One file of a program: what it is for, its name and its text."""

    role: str
    name: str
    text: str
    executable: bool = False


@dataclass(frozen=True, eq=False)
class ProgramRequest:
    """Ask for a program that moves `model` along `motion`, sampled at `rate` [Hz] where the format
    samples; `name` is free text.

    `clearance` says how near bodies come to each other on the way, None where nobody looked.

    Raises
    ------
    MotionError
        If the motion, or its slow dry run, violates a limit of the robot, or does not start and end
        at rest.
    """

    model: RobotModel
    motion: Motion
    name: str
    rate: float
    clearance: Clearance | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise MotionError(
                "the rate of a program must be a positive number of samples per second, got"
                f" {self.rate:g}"
            )
        self.report.raise_if_violated()
        try:
            check_motion(self.model, self.dry_run, DRY_RUN_CHECK_RATE).raise_if_violated()
        except MotionError as error:
            raise MotionError(
                f"the dry run at {100 / DRY_RUN_SLOWDOWN:g} % of the speed violates a limit that"
                f" the motion keeps: {error}"
            ) from None
        top = self.motion.peaks(1)
        for where, time in (("start", 0.0), ("end", self.motion.duration)):
            speed = np.abs(self.motion.derivative(time, 1))
            j = int(np.argmax(speed - REST * top))
            if speed[j] > REST * top[j] + 1e-9:
                raise MotionError(
                    f"joint {self.model.joint_names[j]} moves at {speed[j]:g} (rad or m)/s at the"
                    f" {where} of the motion; a controller needs it at rest there: give a motion"
                    " that starts and ends at rest (FourierMotion, BSplineMotion, QuinticMotion)"
                )

    @cached_property
    def report(self) -> LimitReport:
        """The margins to the limits, on a 1 kHz grid."""
        return check_motion(self.model, self.motion)

    @cached_property
    def dry_run(self) -> Motion:
        """The same path, slow."""
        return self.motion.slowed(DRY_RUN_SLOWDOWN)

    @property
    def stem(self) -> str:
        """The name of the files, without suffix."""
        return file_stem(self.name)

    @property
    def revolute(self) -> tuple[bool, ...]:
        """Which joints turn."""
        return tuple(joint.is_revolute for joint in self.model.joints)

    @property
    def approach_speed(self) -> Array:
        """Top speed of each joint on the way to the start pose (n,)."""
        slow = np.array([APPROACH_SPEED[turns] for turns in self.revolute])
        return read_only(np.minimum(slow, APPROACH_FRACTION * MotionBounds.of(self.model).velocity))

    @property
    def start_tolerance(self) -> Array:
        """How far each joint may be from the start pose (n,)."""
        return np.array([START_TOLERANCE[turns] for turns in self.revolute])

    @property
    def period_ms(self) -> int:
        """The sampling period in whole milliseconds, which KUKA's controllers count in.

        Raises MotionError for other rates.
        """
        period = round(1000.0 / self.rate)
        if period < 1 or abs(period * self.rate - 1000.0) > 1e-6:
            raise MotionError(
                f"the controller samples every 1, 2, 3, ... ms; {self.rate:g} Hz is none of these:"
                " choose 1000, 500, 250, 200, 125 or 100"
            )
        return period


class ProgramFormat(ABC):
    """A kind of controller: `key` names it, `default_rate` [Hz] suits it.

    `n_joints` is how many revolute joints it moves, None for any.

    `smooth` says that it takes only motions whose acceleration does not jump.
    """

    key: ClassVar[str]
    title: ClassVar[str]
    default_rate: ClassVar[float]
    n_joints: ClassVar[int | None] = None
    smooth: ClassVar[bool] = False

    @abstractmethod
    def files(self, request: ProgramRequest) -> tuple[ProgramFile, ...]:
        """Return the files of the program, the recording sheet among them."""

    def check_parametrisation(self, parametrisation: str) -> None:
        """Raise MotionError if motions of this kind are none that the controller takes, before any
        is designed.
        """
        if self.smooth and parametrisation in JUMPING:
            raise MotionError(
                f"the format {self.key} takes no {parametrisation} motion, nor static poses joined"
                " by such: its acceleration jumps, where the robot stops; choose --parametrisation"
                " fourier, bspline or quintic and no --static, or another format"
            )

    def check_joints(self, model: RobotModel) -> None:
        """Raise MotionError if the format cannot move this robot."""
        if self.n_joints is None:
            return
        sliding = [joint.name for joint in model.joints if not joint.is_revolute]
        if model.n_joints != self.n_joints or sliding:
            has = f"{model.n_joints} joints" + (
                f", of which {', '.join(sliding)} slide" if sliding else ""
            )
            raise MotionError(
                f"the format {self.key} is for robots with {self.n_joints} revolute joints"
                f" ({self.title}); {model.name} has {has}. The formats ros2 and csv take any robot."
            )
