"""The formats by name, and the one call that makes a program."""

from __future__ import annotations

from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.excitation.collision.clearance import clearance_along
from asbuilt.excitation.motions.motion import Motion
from asbuilt.writers.programs.formats.franka import FrankaFormat
from asbuilt.writers.programs.formats.fri import FriFormat
from asbuilt.writers.programs.formats.plain_csv import CsvFormat
from asbuilt.writers.programs.formats.ros2 import Ros2Format
from asbuilt.writers.programs.formats.sunrise import SunriseFormat
from asbuilt.writers.programs.formats.urscript import UrScriptFormat
from asbuilt.writers.programs.request import ProgramFile, ProgramFormat, ProgramRequest

PROGRAM_FORMATS: dict[str, ProgramFormat] = {
    kind.key: kind()
    for kind in (SunriseFormat, FriFormat, Ros2Format, UrScriptFormat, FrankaFormat, CsvFormat)
}
"""Every format by its key."""


def program_format(
    key: str, model: RobotModel | None = None, parametrisation: str | None = None
) -> ProgramFormat:
    """Return the format of this name.

    With a `model` or a `parametrisation`, make sure that the format can move the one along motions
    of the other.

    Raises
    ------
    UsageError
        If there is no such format.
    MotionError
        If it cannot move the robot, or not so.
    """
    if key not in PROGRAM_FORMATS:
        raise UsageError(f"unknown program format {key!r}; available: {', '.join(PROGRAM_FORMATS)}")
    chosen = PROGRAM_FORMATS[key]
    if model is not None:
        chosen.check_joints(model)
    if parametrisation is not None:
        chosen.check_parametrisation(parametrisation)
    return chosen


def program_request(
    model: RobotModel,
    motion: Motion,
    form: str,
    *,
    name: str = "excitation",
    rate: float | None = None,
    collision: str | None = None,
) -> ProgramRequest:
    """Return the checked request for a program of this format, with the arguments of
    `make_program`; raises as that does.
    """
    chosen = program_format(form, model)
    clearance = None if collision is None else clearance_along(model, motion, collision)
    return ProgramRequest(
        model, motion, name, chosen.default_rate if rate is None else float(rate), clearance
    )


def make_program(
    model: RobotModel,
    motion: Motion,
    form: str,
    *,
    name: str = "excitation",
    rate: float | None = None,
    collision: str | None = None,
) -> tuple[ProgramFile, ...]:
    """Return the files of the program that moves `model` along `motion` on a controller of this
    format, its recording sheet among them.

    `rate` [Hz] is that of the points or of the recording, as the format has it; by default what
    suits it. With bodies in `collision` (what `--collision` takes) the program says how near they
    come. Nothing is written here.

    Raises
    ------
    UsageError
        If there is no such format.
    MotionError
        If the format cannot move this robot or sample at this rate, or the motion violates a limit,
        runs bodies into each other or does not start and end at rest.

    Examples
    --------
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.excitation.motions.random_motion import random_fourier
    >>> robot = bundled_robot("scara")
    >>> [file.name for file in make_program(robot, random_fourier(robot, rng=1, duration=4.0), "ros2", name="run 1")]
    ['run_1_run.py', 'run_1.yaml', 'run_1_dry_run.yaml', 'run_1_bag.toml']
    """
    return program_format(form).files(
        program_request(model, motion, form, name=name, rate=rate, collision=collision)
    )
