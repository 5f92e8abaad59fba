"""Programs that make a controller run a motion."""

from __future__ import annotations

import os

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.excitation.collision.clearance import clearance_along
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.motion_csv import read_motion
from asbuilt.writers.programs.format import ProgramFile, program_format
from asbuilt.writers.programs.request import ProgramRequest


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
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    chosen = program_format(form, model)
    moved = motion if isinstance(motion, Motion) else read_motion(motion, model)
    clearance = None if collision is None else clearance_along(model, moved, collision)
    frequency = chosen.default_rate if rate is None else float(rate)
    return ProgramRequest(model, moved, name, frequency, clearance)


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
        Rate of the points or of the recording [Hz]; by default that of the format.
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
    >>> from asbuilt.excitation.motions.random_motion import random_fourier
    >>> motion = random_fourier(load_robot("scara"), rng=1, duration=4.0)
    >>> [file.name for file in make_program("scara", motion, "ros2", name="run 1")]
    ['run_1_run.py', 'run_1.yaml', 'run_1_dry_run.yaml', 'run_1_bag.toml']
    """
    request = program_request(robot, motion, form, name=name, rate=rate, collision=collision)
    return program_format(form).files(request)
