"""Design of the most informative motion that a robot may make, of given duration or precision."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import BaseParameters, DriveSet, find_base_parameters, inverse_dynamics
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.collision.constraint import build_constraints
from asbuilt.excitation.design.design_options import DesignOptions
from asbuilt.excitation.design.designed_motion import (
    Design,
    DurationTrial,
    Objective,
    describe_design,
    locate_base_parameter,
)
from asbuilt.excitation.design.multistart import Deadline, SearchProgress, open_pool
from asbuilt.excitation.design.search import DesignSearch
from asbuilt.excitation.information.information import (
    AOptimality,
    Criterion,
    Information,
    parameter_scale,
    select_criterion,
)
from asbuilt.excitation.information.information_bound import InformationBound, information_bound
from asbuilt.excitation.limits import MotionBounds, refuse_open_postures
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.state_constraint import StateConstraint
from asbuilt.executor import count_cores

Progress = Callable[[SearchProgress], None]


# Divide the time limit of a design.

DESIGN_BOUNDS = 0.25  # Share of the time limit that the bounds may take; they converge slowly
DESIGN_REFINEMENT = 0.15  # Share that the search leaves to the refinement of its best optima
DESIGN_AFTER_INTERRUPT = 2.0  # Time for refinement after a keyboard interrupt [s]
DESIGN_POOL_FROM = 24  # Random starts from which on a process pool saves more than its start costs
DESIGN_OTHER_DURATION = 0.1  # Relative deviation from the wanted duration that is reported


def design_fixed(
    model: RobotModel,
    base: BaseParameters,
    options: DesignOptions,
    *,
    prior: Array | None = None,
    purpose: Array | None = None,
    constraints: Sequence[StateConstraint] = (),
    with_bound: bool = True,
    cores: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Design:
    """Return the best motion that several local searches find; parameters of `design_motion`."""
    bounds = MotionBounds.assumed(model, options.fraction)
    options, family = choose_size(options, bounds)
    noise = options.noise if isinstance(options.noise, float) else np.array(options.noise)
    information = Information.of(model, base, noise)
    scale = parameter_scale(information, bounds)
    objective = Objective(
        information,
        _select_criterion(base, options, purpose, scale),
        scale,
        # Information is per independent sample: noise refers to so many a second.
        options.seconds * options.information_rate,
        _check_matrix(prior, base, "prior information"),
    )
    # Compilation would take the time of the search.
    _compile(information)
    limit = options.longest
    whole = Deadline(limit)
    reserve = DESIGN_REFINEMENT * limit
    deadline = Deadline((1.0 - DESIGN_REFINEMENT) * limit)
    search = DesignSearch(objective, options, family, tuple(constraints), deadline)
    # Starting processes takes longer than few searches.
    others = (cores or count_cores()) - 1 if options.starts >= DESIGN_POOL_FROM else 0
    bound = family_bound = None
    with use_one_blas_thread(), open_pool(search.search, others, scheduler) as pool:
        if with_bound:
            bound, family_bound = design_bounds(information, options, family, progress)
        # The bounds have taken their share: what is left is the search's.
        candidates = search.run(pool, progress)
        if not candidates:
            raise search.failure()
        left = max(limit - whole.elapsed, reserve)
        # After an interrupt the best is still made to hold its limits, quickly.
        final = Deadline(DESIGN_AFTER_INTERRUPT if deadline.interrupted else left)
        report = (
            None if progress is None else partial(_report_refinement, progress, candidates[0].value)
        )
        refined = search.refine(candidates, final, pool, report)
    if not refined:
        raise MotionError(
            f"{model.name}: the motions found violate a limit between the nodes of the search; "
            f"allow more starts or fewer {family.size_name}"
        )
    motion = search.motion(refined[0])
    return describe_design(
        options,
        family,
        motion,
        objective,
        constraints=constraints,
        bound=bound,
        family_bound=family_bound,
        value=refined[0].value,
        candidates=tuple(candidate.value for candidate in candidates),
        seconds=whole.elapsed,
        interrupted=deadline.interrupted or final.interrupted,
        notes=_report_other_duration(family, options, motion),
    )


def choose_size(
    options: DesignOptions, bounds: MotionBounds
) -> tuple[DesignOptions, Parametrisation]:
    """Return the options with size and periods that suit the limits, and the family of motions."""
    kind = PARAMETRISATIONS.find(options.parametrisation)
    size = options.size
    periods = options.periods
    if size is None:
        # Options that name a size keep it, and its periods.
        size, periods = kind.usual_size(options.seconds, periods, bounds)
    return replace(options, size=size, periods=periods), kind(options.seconds, size, periods or 1)


def design_bounds(
    information: Information,
    options: DesignOptions,
    family: Parametrisation,
    progress: Progress | None = None,
) -> tuple[InformationBound, InformationBound | None]:
    """Return the bound over all states within the limits, and that for band-limited motions.

    A series whose highest frequency is w obeys `|qd| <= w r` and `|qdd| <= w max |qd|`, r half the
    range of q (Bernstein 1912). Bounds that run out of time are looser, but still bounds.
    """
    model = information.model
    bounds = MotionBounds.assumed(model, options.fraction)
    torque = options.torque_fraction * MotionBounds.of(model).torque
    # Band-limited families have a second bound, of states that they can reach.
    count = 1 + family.band_limited
    begun = Deadline(DESIGN_BOUNDS * options.longest)

    def bound_within(limits: MotionBounds, number: int) -> InformationBound:
        if progress is not None:
            progress(SearchProgress(begun.elapsed, begun.seconds, number, count, -np.inf, "bound"))
        # What time is left is shared by the bounds that remain.
        own = Deadline((begun.seconds - begun.elapsed) / (count - number))
        return information_bound(
            model, information, limits, torque=torque, seed=options.seed, cancelled=own
        )

    whole = bound_within(bounds, 0)
    if not family.band_limited:
        return whole, None
    highest = 2 * np.pi / family.shortest_wave
    # Bernstein: |qd| <= w r, |qdd| <= w max |qd|.
    velocity = np.minimum(bounds.velocity, highest * (bounds.upper - bounds.lower) / 2)
    acceleration = np.minimum(bounds.acceleration, highest * velocity)
    own = bound_within(replace(bounds, velocity=velocity, acceleration=acceleration), 1)
    # A bound that ran out of time may be looser than the one over all states.
    return whole, own if own.upper < whole.upper else whole


def _compile(information: Information) -> None:
    """Compile the kernels of a search before its time starts."""
    model = information.model
    # One state is enough: kernels do not depend on the number.
    rest = np.zeros((1, model.n_joints))
    rows = information.rows(rest, rest, rest)
    information.state_gradient(rest, rest, rest, rows, np.eye(information.n_parameters))
    inverse_dynamics(model, rest, rest, rest)
    torque_derivatives(model, rest, rest, rest)


def _report_other_duration(
    family: Parametrisation, options: DesignOptions, motion: Motion
) -> tuple[str, ...]:
    """Report a duration other than the wanted one, which only poses have."""
    # Poses take the time that their moves need.
    more = family.size_name
    ratio = motion.duration / options.seconds
    if abs(ratio - 1.0) < DESIGN_OTHER_DURATION:
        return ()
    cure = f"more {more} fill the time" if ratio < 1.0 else f"fewer {more} take less time"
    return (
        f"the {more} take {motion.duration:.3g} s at the limits, not {options.seconds:g} s; {cure}",
    )


def _report_refinement(progress: Progress, best: float, state: SearchProgress) -> None:
    progress(replace(state, best=max(best, state.best), phase="refinement"))


def _select_criterion(
    base: BaseParameters, options: DesignOptions, purpose: Array | None, scale: Array
) -> Criterion:
    """Return the criterion of the options, or the variance of what the purpose weighs."""
    weight = _check_matrix(purpose, base, "purpose")
    focus = [locate_base_parameter(base, name) for name in options.focus] or None
    if weight is None:
        return select_criterion(options.criterion, focus)
    if focus is not None:
        raise UsageError("a purpose weighs all parameters; leave the focus out")
    # tr(A C) in the units in which the criterion sees the parameters.
    return AOptimality(weight * np.outer(scale, scale))


def _check_matrix(given: Array | None, base: BaseParameters, what: str) -> Array | None:
    if given is None:
        return None
    matrix = np.asarray(given, dtype=np.float64)
    shape = (base.n_base, base.n_base)
    if matrix.shape != shape:
        raise UsageError(
            f"the {what} has shape {matrix.shape}, expected {shape}; use the same drive"
            " terms as the earlier identification"
        )
    return matrix


# Configure the search for a duration.

# DURATION_FIRST, DURATION_LONGEST: first and longest duration tried [s]; half an hour is a long
# recording
DURATION_FIRST = 10.0
DURATION_LONGEST = 1800.0
DURATION_LONGEST_PERIOD = 40.0  # Duration from which on a Fourier series repeats [s]
DURATION_STEP = 5.0  # Durations are multiples of this [s]
DURATION_TRIALS = 8  # Durations tried at most; errors fall with the square root, so few are needed
DURATION_STARTS = 6  # Random starts of a trial
SHORTEST_LIMIT = 0.1  # Time limit [s] of a design for which none is left: a first motion


def design_for_precision(
    model: RobotModel,
    base: BaseParameters,
    options: DesignOptions,
    *,
    progress: Callable[[SearchProgress], None] | None = None,
    **given: Any,
) -> Design:
    """Return a design just long enough for `Design.precision` to be at most `options.precision`.

    Errors fall with the square root of the duration, which gives the next duration to try. A time
    limit of the options holds for all designs together. A keyboard interrupt ends the trials and
    returns the motion of that moment. `given` are further parameters of `design_fixed`.

    Raises
    ------
    MotionError
        If half an hour is not enough.
    """
    trials: list[DurationTrial] = []
    duration = DURATION_FIRST
    wanted_precision = options.precision
    deadline = Deadline(options.longest)
    for _ in range(DURATION_TRIALS):
        wanted = _limit_time(_set_duration(options, duration), deadline)
        quick = replace(wanted, starts=min(DURATION_STARTS, options.starts))
        report = None if progress is None else partial(_report_trial, progress, duration)
        # A trial shows precision; efficiency is asked of the last design alone.
        design = design_fixed(model, base, quick, progress=report, **{**given, "with_bound": False})
        reached = design.precision
        trials.append(DurationTrial(duration, design.size, design.options.periods or 1, reached))
        if design.interrupted:
            return replace(design, trials=tuple(trials))
        if reached <= wanted_precision:
            final = design_fixed(
                model, base, _limit_time(wanted, deadline), progress=progress, **given
            )
            # The longer search of the final design starts elsewhere, and may end below the quick
            # one.
            best = final if final.precision <= wanted_precision else design
            return replace(best, trials=tuple(trials))
        # Errors fall with the square root of the duration.
        needed = duration * (reached / wanted_precision) ** 2
        step = DURATION_STEP
        # At least a step more, at most four times: the rule holds near the present duration.
        duration = max(duration + step, step * math.ceil(min(needed, 4 * duration) / step))
        if duration > DURATION_LONGEST or deadline():
            break
    raise _make_failure_error(model, wanted_precision, trials, duration, design.size_name)


def _limit_time(options: DesignOptions, deadline: Deadline) -> DesignOptions:
    """Return options whose time limit is what is left, so that a design ends where none is."""
    if options.time_limit is None:
        return options
    return replace(options, time_limit=max(deadline.seconds - deadline.elapsed, SHORTEST_LIMIT))


def _make_failure_error(
    model: RobotModel, precision: float, trials: list[DurationTrial], duration: float, points: str
) -> MotionError:
    best = min(trials, key=lambda trial: trial.precision)
    last = trials[-1]
    if best is not last:
        return MotionError(
            f"{model.name}: a precision of {precision:g} of the torque was not reached; the best is"
            f" {best.precision:.3g} with {best.duration:g} s and {best.size} {points}, and for"
            " longer motions the search finds nothing better; allow more starts, or use a Fourier"
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
    longest = DURATION_LONGEST_PERIOD
    # A long series would have many harmonics for no more information: it repeats.
    repeats = options.parametrisation == "fourier" and duration > longest
    periods = math.ceil(duration / longest) if repeats else None
    return replace(options, duration=duration, periods=periods)


def design_motion(
    robot: RobotModel | str | os.PathLike[str],
    options: DesignOptions | None = None,
    *,
    base: BaseParameters | None = None,
    prior: Array | None = None,
    purpose: Array | None = None,
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
        Configuration; a time limit covers bounds, search and refinement.
    base
        Base parameters to determine; by default with the drive terms `options.drive`.
    prior
        Information (p, p) about the base parameters from earlier recordings.
    purpose
        Matrix A (p, p): the motion has the least `tr(A C)`, C the covariance of the base
        parameters. With A the mean of `Y^T Y` over the states of a motion that is the variance of
        the torque predicted there. It takes the place of the options' criterion.
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
    model = load_robot(robot)
    refuse_open_postures(model)
    model.require_root(
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
        purpose=purpose,
        constraints=(*kept, *constraints),
        with_bound=with_bound,
        cores=cores,
        scheduler=scheduler,
        progress=progress,
    )
