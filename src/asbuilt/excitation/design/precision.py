"""Shortest duration for a wanted precision."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import MotionError
from asbuilt.excitation.design.designed_motion import Design, DurationTrial
from asbuilt.excitation.design.fixed_duration import design_fixed
from asbuilt.excitation.design.multistart import SearchProgress
from asbuilt.excitation.design.options import DesignOptions


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
        wanted = _of_duration(options, duration)
        quick = replace(
            wanted,
            starts=min(SEARCH.starts, options.starts),
            time_limit=min(SEARCH.time_limit, options.time_limit),
        )
        report = None if progress is None else partial(_trying, progress, duration)
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
    raise _failure(model, wanted_precision, trials, duration, design.size_name)


def _failure(
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


def _trying(
    progress: Callable[[SearchProgress], None], duration: float, state: SearchProgress
) -> None:
    progress(replace(state, phase=f"try {duration:g} s"))


def _of_duration(options: DesignOptions, duration: float) -> DesignOptions:
    longest = SEARCH.longest_period
    repeats = options.parametrisation == "fourier" and duration > longest
    periods = math.ceil(duration / longest) if repeats else None
    return replace(options, duration=duration, periods=periods)
