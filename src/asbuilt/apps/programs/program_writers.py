"""Programs that make a controller run a motion, as files, text and documents, and for the core."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from asbuilt.apps.programs.format import (
    DRY_RUN_SLOWDOWN,
    ProgramFile,
    ProgramRequest,
    program_format,
)
from asbuilt.description import RobotModel, load_robot
from asbuilt.excitation import Motion, measure_clearance, read_motion
from asbuilt.tables import wrap_text
from asbuilt.writers import (
    PROGRAM_WRITERS,
    ProgramWriter,
    describe_margins,
    path_texts,
    tabulate_margins,
)
from asbuilt.writing import atomic_write


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


def program_request(
    robot: RobotModel | str | os.PathLike[str],
    motion: Motion | str | os.PathLike[str],
    form: str,
    *,
    name: str = "excitation",
    rate: float | None = None,
    collision: str | None = None,
) -> ProgramRequest:
    """Return the checked request for a program; parameters and errors of `make_program`."""
    model = load_robot(robot)
    chosen = program_format(form, model)
    moved = motion if isinstance(motion, Motion) else read_motion(motion, model)
    clearance = None if collision is None else measure_clearance(model, moved, collision)
    return ProgramRequest(
        model, moved, name, chosen.default_rate if rate is None else float(rate), clearance
    )


def make_program(
    robot: RobotModel | str | os.PathLike[str],
    motion: Motion | str | os.PathLike[str],
    form: str,
    *,
    name: str = "excitation",
    rate: float | None = None,
    collision: str | None = None,
) -> tuple[ProgramFile, ...]:
    """Return the files of a program that moves a robot along a motion and records it.

    Nothing is written; `write_program` does.

    Parameters
    ----------
    robot
        Robot, name of a bundled robot, or path of a description.
    motion
        Motion, or path of a motion file.
    form
        Program format, one of `PROGRAM_FORMATS`.
    name
        Name of the motion and its files.
    rate
        Rate of the points or of the recording [Hz]; by default the format's.
    collision
        Bodies whose smallest distance the program states, as in `DesignOptions`.

    Raises
    ------
    UsageError
        If there is no such format.
    MotionError
        If the format cannot move this robot or sample at this rate, or the motion violates a limit,
        makes bodies collide, or does not start and end at rest.

    Examples
    --------
    >>> from asbuilt.description.load import load_robot
    >>> from asbuilt.excitation.motions.fourier import random_fourier
    >>> motion = random_fourier(load_robot("scara"), rng=1, duration=4.0)
    >>> [file.name for file in make_program("scara", motion, "ros2", name="run 1")]
    ['run_1_run.py', 'run_1.yaml', 'run_1_dry_run.yaml', 'run_1_bag.toml']
    """
    request = program_request(robot, motion, form, name=name, rate=rate, collision=collision)
    return program_format(form).files(request)


def write_program(folder: str | os.PathLike[str], files: Sequence[ProgramFile]) -> dict[str, Path]:
    """Write the files of a program into a folder and return them by role.

    Scripts become executable.
    """
    written = {}
    for file in files:
        written[file.role] = path = atomic_write(Path(folder) / file.name, file.text)
        if file.executable:
            path.chmod(path.stat().st_mode | 0o111)
    return written


def program_document(
    request: ProgramRequest, form: str, files: Mapping[str, Path]
) -> dict[str, Any]:
    """Return the JSON document of a program."""
    return {
        "robot": request.model.name,
        "format": form,
        "motion": request.name,
        "duration": request.motion.duration,
        "dry_run_duration": DRY_RUN_SLOWDOWN * request.motion.duration,
        "rate": request.rate,
        "start": request.motion.start.tolist(),
        "worst_margin": request.report.worst_margin,
        "collision_distance": None if request.clearance is None else request.clearance.distance,
        "files": path_texts(files),
    }


def program_text(request: ProgramRequest, form: str, *, full: bool = False) -> str:
    """Return a program as text: limits, what is not checked, margins."""
    known = request.clearance
    collisions = (
        "NOT CHECKED: collisions, and the approach to the start pose"
        if known is None
        else (
            f"smallest distance between bodies of {known.source} {1000 * known.distance:.0f} mm;"
            " NOT CHECKED: collisions with anything else, and the approach to the start pose"
        )
    )
    title = (
        f"{request.model.name} - {form} program of {request.name},"
        f" {request.motion.duration:.3f} s, dry run {request.dry_run.duration:.1f} s"
    )
    return "\n".join(
        [
            wrap_text(title),
            wrap_text(describe_margins(request.report)),
            wrap_text(collisions),
            "Run the dry run first; the header of the program says how.",
            "",
            tabulate_margins(request.report).as_text(full).rstrip(),
        ]
    )
