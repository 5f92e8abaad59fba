"""Programs of designed motions, for the core."""

from __future__ import annotations

from pathlib import Path

from asbuilt.apps.programs.controller_program import make_program, write_program
from asbuilt.apps.programs.format import program_format
from asbuilt.description import RobotModel
from asbuilt.excitation import Motion
from asbuilt.writers import PROGRAM_WRITERS, ProgramWriter


class ControllerPrograms(ProgramWriter):
    """Write programs of every registered format."""

    def check(self, form: str, model: RobotModel, parametrisation: str | None = None) -> None:
        """Raise an error if there is no such format, or it cannot move the robot so."""
        program_format(form, model, parametrisation)

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
        made = make_program(model, motion, form, name=name, collision=collision)
        return write_program(folder, made)


PROGRAM_WRITERS.register("controller", ControllerPrograms())
