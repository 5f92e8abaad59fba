"""How long a motion must be for a wanted precision."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import described_drive, drive_torque
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.design.design import Design, design_motion, position_of
from asbuilt.excitation.design.interior_point import StateConstraint
from asbuilt.excitation.design.multistart import SearchProgress
from asbuilt.excitation.design.options import DesignOptions

USUAL_PRECISION = 0.002
"""Share of the torque that the standard error of a parameter may change, where no other is asked
for.
"""
SHORTEST, LONGEST_PERIOD, LONGEST = 10.0, 40.0, 1800.0
"""The first duration that is tried, the longest in one period, and the longest at all [s]."""
STEP = 5.0
"""Durations are multiples of this [s]."""
TRIALS = 8
"""Durations that are tried at most.

Each comes from the last by the square root of time, so a few are enough.
"""
TRIAL_STARTS, TRIAL_LIMIT = 6, 5.0
"""Random starts and time [s] of a design that only judges a duration."""


@dataclass(frozen=True, slots=True)
class DurationTrial:
    """A duration that was tried: harmonics, periods, and the precision that its motion would give."""

    duration: float
    size: int
    periods: int
    precision: float


def predicted_precision(design: Design) -> float:
    """Return the largest torque error that one parameter's standard error causes, as a fraction of
    the torque, both RMS along the motion.

    It is the largest of the `torque_effects` of the parameters in focus, of all where there is
    none. Raises UsageError where the description has no masses.
    """
    effects = torque_effects(design)
    if np.any(np.isnan(effects)):
        raise UsageError(
            f"the description of {design.model.name} gives no masses, so a precision relative to"
            " its torque has no meaning"
        )
    chosen = [position_of(design.base, name) for name in design.options.focus] or slice(None)
    return float(effects[chosen].max())


def torque_effects(design: Design) -> Array:
    """Return `std_i rms(column_i) / rms(torque)` of every base parameter (p,), torques in units of
    the noise; NaN where the description has no masses.

    The torque is that of the description. Unlike the error relative to the parameter it makes sense
    for parameters near zero.
    """
    drive, values = described_drive(design.model)
    t = design.motion.sample_times(100.0)
    state = design.motion.at(t)
    rigid = inverse_dynamics(design.model, *state)
    torque = (
        rigid + drive_torque(drive, values, *state, load=rigid, shares=design.model.motor_shares)
    ) / design.noise
    size = float(np.sqrt(np.mean((torque**2).sum(axis=1))))
    effects: Array = design.std_errors * np.sqrt(np.diag(design.mean_information))
    return effects / size if size > 0 else np.full_like(effects, np.nan)


def design_for_precision(
    model: RobotModel,
    drive: DriveSet,
    options: DesignOptions,
    precision: float,
    *,
    prior: Array | None = None,
    constraints: Sequence[StateConstraint] = (),
    progress: Callable[[SearchProgress], None] | None = None,
) -> tuple[Design, tuple[DurationTrial, ...]]:
    """Return a design just long enough for `predicted_precision` to be at most `precision`, and the
    durations that were tried.

    Errors fall with the square root of the duration; that gives the next duration to try, in steps
    of 5 s. Beyond 40 s the motion is repeated in periods. The harmonics are those of the options,
    or go with the period. The time limit of the options holds for the last design; each try before
    it takes some seconds. A keyboard interrupt ends the tries; the motion of that moment is
    returned.

    Raises
    ------
    UsageError
        If the precision is not a positive number.
    MotionError
        If half an hour is not enough.
    """
    if not (math.isfinite(precision) and precision > 0):
        raise UsageError(
            "the precision must be a positive fraction of the torque, such as 0.01, got"
            f" {precision}"
        )
    trials: list[DurationTrial] = []
    duration = SHORTEST
    for _ in range(TRIALS):
        wanted = _of_duration(options, duration)
        quick = replace(
            wanted,
            starts=min(TRIAL_STARTS, options.starts),
            time_limit=min(TRIAL_LIMIT, options.time_limit),
        )
        told = None if progress is None else partial(_told_trial, progress, wanted.duration)
        design = design_motion(
            model,
            drive,
            quick,
            prior=prior,
            constraints=constraints,
            with_bound=False,
            progress=told,
        )
        reached = predicted_precision(design)
        trials.append(
            DurationTrial(wanted.duration, design.size, design.options.periods or 1, reached)
        )
        if design.interrupted:
            return design, tuple(trials)
        if reached <= precision:
            final = design_motion(
                model, drive, wanted, prior=prior, constraints=constraints, progress=progress
            )
            return (final if predicted_precision(final) <= precision else design), tuple(trials)
        needed = duration * (reached / precision) ** 2
        duration = max(duration + STEP, STEP * math.ceil(min(needed, 4 * duration) / STEP))
        if duration > LONGEST:
            break
    best = min(trials, key=lambda trial: trial.precision)
    if best is not trials[-1]:
        raise MotionError(
            f"{model.name}: a precision of {precision:g} of the torque was not found."
            f" {best.duration:g} s with {best.size} {design.size_name} would give"
            f" {best.precision:.3g}, but among the many of longer motions the search finds nothing"
            " better; allow it more time, or take a Fourier series, which repeats"
        )
    raise MotionError(
        f"{model.name}: a precision of {precision:g} of the torque takes more than {duration:.0f}"
        f" s; the last try of {trials[-1].duration:g} s gives {trials[-1].precision:.3g}. Allow"
        " more harmonics or more of the limits, reduce the noise, or ask for less"
    )


def _told_trial(
    progress: Callable[[SearchProgress], None], duration: float, state: SearchProgress
) -> None:
    progress(replace(state, phase=f"try {duration:g} s"))


def _of_duration(options: DesignOptions, duration: float) -> DesignOptions:
    periods = (
        math.ceil(duration / LONGEST_PERIOD)
        if options.parametrisation == "fourier" and duration > LONGEST_PERIOD
        else None
    )
    return replace(options, duration=duration, periods=periods)
