"""Design of a motion of given duration: bounds, search, refinement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.batches import count_cores
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.design.designed_motion import (
    Design,
    Objective,
    describe_design,
    locate_base_parameter,
)
from asbuilt.excitation.design.multistart import Deadline, SearchProgress, open_pool, search_all
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.design.search import DesignSearch, Task
from asbuilt.excitation.information.criteria import select_criterion
from asbuilt.excitation.information.information import Information, parameter_scale
from asbuilt.excitation.information.information_bound import InformationBound, information_bound
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation
from asbuilt.excitation.state_constraint import StateConstraint

Progress = Callable[[SearchProgress], None]


@dataclass(frozen=True)
class DesignBudget:
    """Divide the time limit of a design.

    | field | meaning and source |
    |---|---|
    | `bounds` | share of the time limit that the bounds may take; they converge slowly |
    | `refinement` | share that the search leaves to the refinement of its best optima |
    | `refined` | number of best local optima refined on the dense grid |
    | `after_interrupt` | time for refinement after a keyboard interrupt [s] |
    | `pool_from` | random starts from which on a process pool saves more than its start costs |
    | `other_duration` | relative deviation from the wanted duration that is reported |
    """

    bounds: float = 0.25
    refinement: float = 0.15
    refined: int = 4
    after_interrupt: float = 2.0
    pool_from: int = 24
    other_duration: float = 0.1


BUDGET = DesignBudget()


def design_fixed(
    model: RobotModel,
    base: BaseParameters,
    options: DesignOptions,
    *,
    prior: Array | None = None,
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
    focus = [locate_base_parameter(base, name) for name in options.focus] or None
    objective = Objective(
        information,
        select_criterion(options.criterion, focus),
        parameter_scale(information, bounds),
        options.seconds * options.information_rate,
        _check_prior(prior, base),
    )
    _compile(information)
    whole, reserve = Deadline(options.time_limit), BUDGET.refinement * options.time_limit
    deadline = Deadline(options.time_limit - reserve)
    search = DesignSearch(model, objective, options, family, tuple(constraints), deadline)
    others = (cores or count_cores()) - 1 if options.starts >= BUDGET.pool_from else 0
    bound = family_bound = None
    with use_one_blas_thread(), open_pool(search.search, others, scheduler) as pool:
        if with_bound:
            bound, family_bound = design_bounds(model, information, options, family, progress)
        candidates = search.run(pool, progress)
        if not candidates:
            raise search.failure()
        left = max(options.time_limit - whole.elapsed, reserve)
        final = Deadline(BUDGET.after_interrupt if deadline.interrupted else left)
        report = (
            None if progress is None else partial(_report_refinement, progress, candidates[0].value)
        )
        tasks = [Task(found.number, found, final) for found in candidates[: BUDGET.refined]]
        refined = search_all(tasks, search.search, final, pool=pool, progress=report)
    if not refined:
        raise MotionError(
            f"{model.name}: the motions found violate a limit between the nodes of the search; "
            f"allow more time or fewer {family.size_name}"
        )
    motion = search.motion(refined[0])
    return describe_design(
        model,
        base,
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
    size, periods = options.size, options.periods
    if size is None:
        size, periods = kind.usual_size(options.seconds, periods, bounds)
    family = kind.of(options.seconds, size, periods or 1)
    return replace(options, size=size, periods=periods), family


def design_bounds(
    model: RobotModel,
    information: Information,
    options: DesignOptions,
    family: Parametrisation,
    progress: Progress | None = None,
) -> tuple[InformationBound, InformationBound | None]:
    """Return the bound over all states within the limits, and that for band-limited motions.

    A series whose highest frequency is w obeys `|qd| <= w r` and `|qdd| <= w max |qd|`, r half the
    range of q (Bernstein 1912). Bounds that run out of time are looser, but still bounds.
    """
    bounds = MotionBounds.assumed(model, options.fraction)
    torque = options.torque_fraction * MotionBounds.of(model).torque
    count = 1 + family.band_limited
    begun = Deadline(BUDGET.bounds * options.time_limit)

    def bound_within(limits: MotionBounds, number: int) -> InformationBound:
        if progress is not None:
            progress(SearchProgress(begun.elapsed, begun.seconds, number, count, -np.inf, "bound"))
        own = Deadline((begun.seconds - begun.elapsed) / (count - number))
        return information_bound(
            model, information, limits, torque=torque, seed=options.seed, cancelled=own
        )

    whole = bound_within(bounds, 0)
    if not family.band_limited:
        return whole, None
    highest = 2 * np.pi / family.shortest_wave
    velocity = np.minimum(bounds.velocity, highest * (bounds.upper - bounds.lower) / 2)
    acceleration = np.minimum(bounds.acceleration, highest * velocity)
    own = bound_within(replace(bounds, velocity=velocity, acceleration=acceleration), 1)
    return whole, own if own.upper < whole.upper else whole


def _compile(information: Information) -> None:
    """Compile the kernels of a search before its time starts."""
    model = information.model
    rest = np.zeros((1, model.n_joints))
    rows = information.rows(rest, rest, rest)
    information.state_gradient(rest, rest, rest, rows, np.eye(information.n_parameters))
    inverse_dynamics(model, rest, rest, rest)
    torque_derivatives(model, rest, rest, rest)


def _report_other_duration(
    family: Parametrisation, options: DesignOptions, motion: Motion
) -> tuple[str, ...]:
    """Report a duration other than the wanted one, which only poses have."""
    more, ratio = family.size_name, motion.duration / options.seconds
    if abs(ratio - 1.0) < BUDGET.other_duration:
        return ()
    cure = f"more {more} fill the time" if ratio < 1.0 else f"fewer {more} take less time"
    return (
        f"the {more} take {motion.duration:.3g} s at the limits, not {options.seconds:g} s; {cure}",
    )


def _report_refinement(progress: Progress, best: float, state: SearchProgress) -> None:
    progress(replace(state, best=max(best, state.best), phase="refinement"))


def _check_prior(prior: Array | None, base: BaseParameters) -> Array | None:
    if prior is None:
        return None
    given, shape = np.asarray(prior, dtype=np.float64), (base.n_base, base.n_base)
    if given.shape != shape:
        raise UsageError(
            f"the prior information has shape {given.shape}, expected {shape}; use the same drive"
            " terms as the earlier identification"
        )
    return given
