"""Controller program formats and their registry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import JUMPING
from asbuilt.findings import Cure
from asbuilt.registry import Registry
from asbuilt.writers.programs.request import ProgramRequest


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
        if self.n_joints is None:
            return
        sliding = [joint.name for joint in model.joints if not joint.is_revolute]
        if model.n_joints != self.n_joints or sliding:
            slide = f", of which {', '.join(sliding)} are prismatic" if sliding else ""
            raise MotionError(
                f"the format {self.key} is for robots with {self.n_joints} revolute joints"
                f" ({self.title}); {model.name} has {model.n_joints} joints{slide}. The formats"
                " ros2 and csv take any robot"
            )


PROGRAM_FORMATS: Registry[ProgramFormat] = Registry(
    "program format", "asbuilt.writers.programs.formats", "asbuilt.program_formats"
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
