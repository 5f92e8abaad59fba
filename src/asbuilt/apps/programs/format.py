"""Controller program formats and their registry, and the checked request for a program."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from asbuilt.apps.programs.naming import make_file_stem
from asbuilt.arrays import Array, read_only
from asbuilt.description import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation import JUMPING, Clearance, LimitReport, Motion, MotionBounds, check_motion
from asbuilt.findings import Cure
from asbuilt.registry import Registry

DRY_RUN_SLOWDOWN = 10.0
"""Factor of the dry run's duration: 10 % of the speed, 1 % of the acceleration."""

REST = 1e-3
"""Speed relative to the top speed below which a motion is at rest at its ends."""


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
        return make_file_stem(self.name)

    @property
    def revolute(self) -> tuple[bool, ...]:
        """Whether each joint is revolute."""
        return tuple(joint.is_revolute for joint in self.model.joints)

    @property
    def approach_speed(self) -> Array:
        """Top speed of each joint on the approach to the start pose (n,) [rad/s or m/s]."""
        # Below the 250 mm/s of ISO 10218 at 1.25 m, and at most a fifth of the velocity limit.
        slow = np.where(self.revolute, 0.2, 0.05)
        limit = MotionBounds.of(self.model).velocity
        return read_only(np.minimum(slow, 0.2 * limit))

    @property
    def start_tolerance(self) -> Array:
        """Allowed deviation of each joint from the start pose (n,) [rad or m]."""
        return np.where(self.revolute, 0.01, 0.002)

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


@dataclass(frozen=True)
class ProgramFile:
    """One file of a program: its role, name and text."""

    role: str
    name: str
    text: str
    executable: bool = False

    def __repr__(self) -> str:
        return f"ProgramFile({self.role!r}, {self.name!r}, {len(self.text)} characters)"


class ProgramFormat(ABC):
    """A controller program format; a subclass registers an instance in `PROGRAM_FORMATS`.

    `key` names it, `default_rate` [Hz] is the usual rate, `n_joints` the number of revolute joints
    it moves (None: any robot), `smooth` whether it needs continuous acceleration.
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
        """Raise `MotionError` if the controller cannot follow motions of this family."""
        if self.smooth and parametrisation in JUMPING:
            raise MotionError(
                f"the format {self.key} takes no {parametrisation} motion or static poses, whose"
                " acceleration jumps: the robot would stop",
                cure=Cure("use a smooth motion or another format", {"parametrisation": "fourier"}),
            )

    def check_joints(self, model: RobotModel) -> None:
        """Raise `MotionError` if the format cannot move this robot."""
        sliding = [joint.name for joint in model.joints if not joint.is_revolute]
        if self.n_joints is not None and (model.n_joints != self.n_joints or sliding):
            slide = f", of which {', '.join(sliding)} are prismatic" if sliding else ""
            raise MotionError(
                f"the format {self.key} is for robots with {self.n_joints} revolute joints"
                f" ({self.title}); {model.name} has {model.n_joints} joints{slide}. The formats"
                " ros2 and csv take any robot"
            )


PROGRAM_FORMATS: Registry[ProgramFormat] = Registry(
    "program format", "asbuilt.apps.programs.program_formats", "asbuilt.program_formats"
)
"""Controller program formats by key."""


def program_format(
    key: str, model: RobotModel | None = None, parametrisation: str | None = None
) -> ProgramFormat:
    """Return the format of this name, checked against a robot and a family of motions.

    Raises
    ------
    UsageError
        If there is no such format.
    MotionError
        If it cannot move the robot, or not along such motions.
    """
    chosen = PROGRAM_FORMATS.find(key)
    if model is not None:
        chosen.check_joints(model)
    if parametrisation is not None:
        chosen.check_parametrisation(parametrisation)
    return chosen
