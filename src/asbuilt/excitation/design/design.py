"""Design of the most informative motion that a robot may make, of given duration or precision."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.free_base import refuse_free_base
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import MotionError
from asbuilt.excitation.collision.constraint import build_constraints
from asbuilt.excitation.design.designed_motion import Design, DurationTrial
from asbuilt.excitation.design.fixed_duration import design_fixed
from asbuilt.excitation.design.multistart import SearchProgress
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.limits import refuse_open_postures
from asbuilt.excitation.state_constraint import StateConstraint


@dataclass(frozen=True)
class DurationSearch:
    """Configure the search for a duration.

    | field | meaning and source |
    |---|---|
    | `first`, `longest` | first and longest duration tried [s]; half an hour is a long recording |
    | `longest_period` | duration from which on a Fourier series repeats [s] |
    | `step` | durations are multiples of this [s] |
    | `trials` | durations tried at most; errors fall with the square root, so few are needed |
    | `starts`, `time_limit` | random starts and time [s] of a trial |
    """

    first: float = 10.0
    longest: float = 1800.0
    longest_period: float = 40.0
    step: float = 5.0
    trials: int = 8
    starts: int = 6
    time_limit: float = 5.0


SEARCH = DurationSearch()


def design_for_precision(
    model: RobotModel,
    base: BaseParameters,
    options: DesignOptions,
    *,
    progress: Callable[[SearchProgress], None] | None = None,
    **given: Any,
) -> Design:
    """Return a design just long enough for `Design.precision` to be at most `options.precision`.

    Errors fall with the square root of the duration, which gives the next duration to try. The time
    limit of the options holds for the last design. A keyboard interrupt ends the trials and returns
    the motion of that moment. `given` are further parameters of `design_fixed`.

    Raises
    ------
    MotionError
        If half an hour is not enough.
    """
    trials: list[DurationTrial] = []
    duration, wanted_precision = SEARCH.first, options.precision
    for _ in range(SEARCH.trials):
        wanted = _set_duration(options, duration)
        quick = replace(
            wanted,
            starts=min(SEARCH.starts, options.starts),
            time_limit=min(SEARCH.time_limit, options.time_limit),
        )
        report = None if progress is None else partial(_report_trial, progress, duration)
        design = design_fixed(model, base, quick, progress=report, **{**given, "with_bound": False})
        reached = design.precision
        trials.append(DurationTrial(duration, design.size, design.options.periods or 1, reached))
        if design.interrupted:
            return replace(design, trials=tuple(trials))
        if reached <= wanted_precision:
            final = design_fixed(model, base, wanted, progress=progress, **given)
            best = final if final.precision <= wanted_precision else design
            return replace(best, trials=tuple(trials))
        needed = duration * (reached / wanted_precision) ** 2
        step = SEARCH.step
        duration = max(duration + step, step * math.ceil(min(needed, 4 * duration) / step))
        if duration > SEARCH.longest:
            break
    raise _make_failure_error(model, wanted_precision, trials, duration, design.size_name)


def _make_failure_error(
    model: RobotModel, precision: float, trials: list[DurationTrial], duration: float, points: str
) -> MotionError:
    best, last = min(trials, key=lambda trial: trial.precision), trials[-1]
    if best is not last:
        return MotionError(
            f"{model.name}: a precision of {precision:g} of the torque was not reached; the best is"
            f" {best.precision:.3g} with {best.duration:g} s and {best.size} {points}, and for"
            " longer motions the search finds nothing better; allow more time, or use a Fourier"
            " series, which repeats",
            precision=best.precision,
            duration=best.duration,
        )
    return MotionError(
        f"{model.name}: a precision of {precision:g} of the torque needs more than {duration:.0f}"
        f" s; {last.duration:g} s give {last.precision:.3g}. Allow more harmonics or more of the"
        " limits, reduce the noise, or accept a lower precision",
        precision=last.precision,
        duration=last.duration,
    )


def _report_trial(
    progress: Callable[[SearchProgress], None], duration: float, state: SearchProgress
) -> None:
    progress(replace(state, phase=f"try {duration:g} s"))


def _set_duration(options: DesignOptions, duration: float) -> DesignOptions:
    longest = SEARCH.longest_period
    repeats = options.parametrisation == "fourier" and duration > longest
    periods = math.ceil(duration / longest) if repeats else None
    return replace(options, duration=duration, periods=periods)


def design_motion(
    robot: RobotModel | str | os.PathLike[str],
    options: DesignOptions | None = None,
    *,
    base: BaseParameters | None = None,
    prior: Array | None = None,
    constraints: Sequence[StateConstraint] = (),
    with_bound: bool = True,
    cores: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> Design:
    """Return the most informative motion that several local searches find within the limits.

    A keyboard interrupt ends the search or the refinement and keeps the best motion so far.

    Parameters
    ----------
    robot
        Robot, name of a bundled robot, or path of a description.
    options
        Configuration; its time limit covers bounds, search and refinement.
    base
        Base parameters to determine; by default with the drive terms `options.drive`.
    prior
        Information (p, p) about the base parameters from earlier recordings.
    constraints
        Constraints in addition to the options'.
    with_bound
        Whether to bound the information of all motions, for `Design.d_efficiency`.
    cores
        Number of processes that search, this one included; by default one for each core. The
        motion is the same for any number unless the time limit ends the search.
    scheduler
        Address of a Dask scheduler, such as `tcp://10.0.0.1:8786`, whose workers search besides
        this process.
    progress
        Called with the state of the search.

    Returns
    -------
    Design
        The motion, its margins to the limits, and predicted standard errors.

    Raises
    ------
    MotionError
        If no motion within the constraints is found, or none determines all parameters.
    UsageError
        If an option names something unknown.

    Examples
    --------
    >>> options = DesignOptions(duration=4.0, size=3, starts=1, drive="viscous")
    >>> design = design_motion("two-link", options, with_bound=False)
    >>> design.limits.is_respected, design.motion.duration
    (True, 4.0)
    """
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    refuse_open_postures(model)
    refuse_free_base(
        model.name,
        model.n_floating,
        "a motion on which it keeps its balance is not designed; squat, twist the trunk and lift"
        " single legs",
    )
    asked = options or DesignOptions()
    kept = build_constraints(
        model, collision=asked.collision, tool_box=asked.tool_box, tool_frame=asked.tool_frame
    )
    design = design_for_precision if asked.duration == "auto" else design_fixed
    return design(
        model,
        base or find_base_parameters(model, DriveSet.parse(asked.drive)),
        asked,
        prior=prior,
        constraints=(*kept, *constraints),
        with_bound=with_bound,
        cores=cores,
        scheduler=scheduler,
        progress=progress,
    )
