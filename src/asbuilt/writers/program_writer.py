"""Writers of programs that make a controller run a motion: what designs of motions ask of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from asbuilt.description import RobotModel
from asbuilt.excitation import Motion
from asbuilt.registry import Registry


class ProgramWriter(ABC):
    """Write controller programs; a subclass registers an instance in `PROGRAM_WRITERS`."""

    @abstractmethod
    def check(self, form: str, model: RobotModel, parametrisation: str | None = None) -> None:
        """Raise an error if there is no such format, or it cannot move the robot so."""

    @abstractmethod
    def write(
        self,
        folder: Path,
        model: RobotModel,
        motion: Motion,
        form: str,
        *,
        name: str,
        collision: str | None,
    ) -> dict[str, Path]:
        """Write the program of a motion into a folder; return its files by role."""


PROGRAM_WRITERS: Registry[ProgramWriter] = Registry(
    "writer of controller programs", None, "asbuilt.program_writers"
)
"""Writers of programs by name."""
