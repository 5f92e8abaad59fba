"""Design a motion: the most informative one that the robot may make."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.batches import available_cores
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.collision.constraint import told_constraints
from asbuilt.excitation.design.interior_point import StateConstraint
from asbuilt.excitation.design.multistart import Deadline, SearchProgress, search_all
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.design.process_pool import Crew
from asbuilt.excitation.design.program import Objective
from asbuilt.excitation.design.search import DesignSearch, Task
from asbuilt.excitation.design.torque_limit import PowerLimit
from asbuilt.excitation.information.criteria import criterion_of
from asbuilt.excitation.information.information import Information, mean_information
from asbuilt.excitation.information.information_bound import InformationBound, information_bound
from asbuilt.excitation.limits import LimitReport, MotionBounds, check_motion
from asbuilt.excitation.motions.motion import Motion, limit_array
from asbuilt.excitation.motions.pacing import CHECK_RATE
from asbuilt.excitation.motions.parametrisations import Fourier
from asbuilt.excitation.state_bounds import limited_model, parameter_scale

USUAL_DRIVE = DriveSet.parse("viscous,coulomb,offset")

MANY_STARTS = 24
"""Random starts from which on other processes are worth the seconds that they take to begin."""

REFINED = 4
"""How many of the best local optima are refined on the dense grid."""

BOUND_SHARE, REFINEMENT_SHARE = 0.25, 0.15
"""The most that the bounds may take of the time limit, and what the search leaves of it to the
refinement of what it finds.
"""

UNTOLD = 1e-6
"""Squared share of a parameter in what a motion does not tell, from which on its error counts as
infinite.
"""

SAME_DURATION = 0.1
"""By what part a motion may last longer or shorter than asked for before that is told.

Only poses do, others last as long as asked.
"""

LAST_REFINEMENT = 2.0
"""Time for refinement after an interrupt [s]."""


@dataclass(frozen=True, eq=False)
class Design:
    """Hold a designed motion and what it is worth.

    `mean_information` (p, p) is `Y^T S^-1 Y` averaged over a 1 kHz grid, with exact drive columns;
    `log_det` refers to `n_samples` independent samples. `limits` are the margins on that grid
    (limits that the description lacks are those of `MotionBounds.assumed`, named in `assumed`),
    `collision_distance` the smallest distance there [m], None where nothing was watched.
    """

    model: RobotModel
    base: BaseParameters
    options: DesignOptions
    motion: Motion
    noise: Array
    size: int
    size_name: str
    mean_information: Array
    prior: Array | None
    bound: InformationBound | None
    family_bound: InformationBound | None
    limits: LimitReport
    assumed: tuple[str, ...]
    collision_distance: float | None
    value: float
    candidates: tuple[float, ...]
    solve_seconds: float
    interrupted: bool
    notes: tuple[str, ...] = field(default=())

    @property
    def n_samples(self) -> float:
        """Independent torque samples of each joint."""
        return self.motion.duration * self.options.information_rate

    @property
    def d_efficiency(self) -> float | None:
        """`exp((log det M - log det M_bound) / p)` per sample.

        The share of the attainable information, None where no bound was found.
        """
        return None if self.bound is None else self.bound.efficiency(self.mean_information)

    @property
    def family_efficiency(self) -> float | None:
        """The same against the smaller bound for motions with these harmonics.

        None for other families.
        """
        return (
            None
            if self.family_bound is None
            else self.family_bound.efficiency(self.mean_information)
        )

    @property
    def information(self) -> Array:
        """The information of the whole motion (p, p), without that from elsewhere."""
        return self.n_samples * self.mean_information

    @property
    def log_det(self) -> float:
        """`log det` of the information of the whole motion."""
        return float(np.linalg.slogdet(self.information)[1])

    @property
    def condition_number(self) -> float:
        """Condition number of the weighted observation matrix."""
        return float(np.sqrt(np.linalg.cond(self.mean_information)))

    @property
    def scaled_condition_number(self) -> float:
        """The same with columns scaled to unit length."""
        size = 1.0 / np.sqrt(np.diag(self.mean_information))
        return float(np.sqrt(np.linalg.cond(self.mean_information * np.outer(size, size))))

    @property
    def std_errors(self) -> Array:
        """Predicted standard errors of the base parameters (p,), from this motion and what was
        known before; infinite where neither tells anything.
        """
        total = self.information if self.prior is None else self.information + self.prior
        size = 1.0 / np.sqrt(np.where(np.diag(total) > 0, np.diag(total), 1.0))
        eigenvalues, vectors = np.linalg.eigh(total * np.outer(size, size))
        told = eigenvalues > len(eigenvalues) * np.finfo(float).eps * eigenvalues[-1]
        errors = size * np.sqrt((vectors[:, told] ** 2 / eigenvalues[told]).sum(axis=1))
        untold = (vectors[:, ~told] ** 2).sum(axis=1)
        return np.where(untold > UNTOLD, np.inf, errors)


def design_motion(
    model: RobotModel,
    drive: DriveSet = USUAL_DRIVE,
    options: DesignOptions | None = None,
    *,
    prior: Array | None = None,
    constraints: Sequence[StateConstraint] = (),
    base: BaseParameters | None = None,
    with_bound: bool = True,
    cores: int | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> Design:
    """Return the best motion that several local searches find within the limits.

    `prior` (p, p) is information about the base parameters from earlier recordings; `constraints`
    are watched besides position, velocity, acceleration, jerk and torque. The time limit of the
    options covers bounds, search and refinement. A keyboard interrupt ends the search or the
    refinement and keeps the best motion so far. Searches run on as many `cores` as given, or all
    there are, in processes of their own where there are many.

    Raises
    ------
    MotionError
        If no start within the constraints is found, or no motion of the family tells all
        parameters.
    """
    asked = options or DesignOptions()
    wanted = asked.for_limits(MotionBounds.assumed(model, asked.fraction))
    found = base or find_base_parameters(model, drive)
    information = Information.of(
        model, found, wanted.noise if isinstance(wanted.noise, float) else np.array(wanted.noise)
    )
    focus = [position_of(found, name) for name in wanted.focus] or None
    scale = parameter_scale(information, MotionBounds.assumed(model, wanted.fraction))
    objective = Objective(
        information,
        criterion_of(wanted.criterion, focus),
        scale,
        wanted.duration * wanted.information_rate,
        _checked_prior(prior, found),
    )
    _loaded(information)
    whole, reserve = Deadline(wanted.time_limit), REFINEMENT_SHARE * wanted.time_limit
    deadline = Deadline(wanted.time_limit - reserve)
    search = DesignSearch(model, objective, wanted, tuple(constraints), deadline)
    others = (cores or available_cores()) - 1 if wanted.starts >= MANY_STARTS else 0
    with one_blas_thread(), closing(Crew(search.search, others)) as crew:
        bound, family_bound = (
            design_bounds(model, information, wanted, progress) if with_bound else (None, None)
        )
        candidates = search.run(crew, progress)
        if not candidates:
            raise search.failure()
        final = Deadline(
            LAST_REFINEMENT
            if deadline.interrupted
            else max(wanted.time_limit - whole.elapsed, reserve)
        )
        told = (
            None if progress is None else partial(_told_refinement, progress, candidates[0].value)
        )
        tasks = [Task(candidate.number, candidate, final) for candidate in candidates[:REFINED]]
        refined = search_all(tasks, search.search, final, crew=crew, progress=told)
    if not refined:
        raise MotionError(
            f"{model.name}: the motions found do not hold between the nodes of the search; ask for"
            f" more time, or for fewer {search.family.size_name}"
        )
    best = refined[0]
    motion = search.motion(best)
    return describe_design(
        model,
        found,
        wanted,
        motion,
        objective,
        constraints=constraints,
        bound=bound,
        family_bound=family_bound,
        value=best.value,
        candidates=tuple(candidate.value for candidate in candidates),
        seconds=whole.elapsed,
        interrupted=deadline.interrupted or final.interrupted,
        notes=_other_duration(search, wanted, motion),
    )


def describe_design(
    model: RobotModel,
    base: BaseParameters,
    options: DesignOptions,
    motion: Motion,
    objective: Objective,
    *,
    constraints: Sequence[StateConstraint] = (),
    bound: InformationBound | None = None,
    family_bound: InformationBound | None = None,
    value: float | None = None,
    candidates: tuple[float, ...] = (),
    seconds: float = 0.0,
    interrupted: bool = False,
    notes: tuple[str, ...] = (),
) -> Design:
    """Return what a motion is worth, evaluated at 1 kHz with exact drive columns, and its margins
    there.
    """
    limited, assumed = limited_model(model)
    t = (
        (np.arange(max(1, int(motion.duration * CHECK_RATE))) + 0.5)
        * motion.duration
        / max(1, int(motion.duration * CHECK_RATE))
    )
    states = motion.at(t)
    mean = mean_information(objective.information, *states)
    distances = [
        constraint.smallest_distance(states[0])
        for constraint in constraints
        if hasattr(constraint, "smallest_distance")
    ]
    return Design(
        model=model,
        base=base,
        options=replace(options, duration=motion.duration),
        motion=motion,
        noise=objective.information.noise,
        size=options.family.size,
        size_name=options.family.size_name,
        mean_information=mean,
        bound=bound,
        family_bound=family_bound,
        prior=objective.prior,
        limits=check_motion(limited, motion, CHECK_RATE),
        assumed=assumed,
        collision_distance=min(distances, default=None),
        value=objective.value(mean) if value is None else value,
        candidates=candidates,
        solve_seconds=seconds,
        interrupted=interrupted,
        notes=(
            *notes,
            *_told_power(model, options, states),
            *told_constraints(constraints, states[0]),
        ),
    )


def design_bounds(
    model: RobotModel,
    information: Information,
    options: DesignOptions,
    progress: Callable[[SearchProgress], None] | None = None,
) -> tuple[InformationBound, InformationBound | None]:
    """Return the bound over all states within the limits, and the one over those that a Fourier
    series with these harmonics can reach.

    A series whose highest frequency is w obeys `|qd| <= w r` and `|qdd| <= w max |qd|`, r half the
    range of q (Bernstein 1912). Each may take half of the share of the time limit that bounds have;
    what is missing then makes it a looser bound.
    """
    bounds, family = MotionBounds.assumed(model, options.fraction), options.family
    torque = options.torque_fraction * MotionBounds.of(model).torque
    fourier = isinstance(family, Fourier)
    begun = Deadline(BOUND_SHARE * options.time_limit)

    def bound_within(limits: MotionBounds, number: int) -> InformationBound:
        if progress is not None:
            progress(
                SearchProgress(begun.elapsed, begun.seconds, number, 1 + fourier, -np.inf, "bound")
            )
        own = Deadline((begun.seconds - begun.elapsed) / (1 + fourier - number))
        return information_bound(
            model, information, limits, torque=torque, seed=options.seed, cancelled=own
        )

    whole = bound_within(bounds, 0)
    if not isinstance(family, Fourier):
        return whole, None
    highest = 2 * np.pi / family.shortest_wave
    velocity = np.minimum(bounds.velocity, highest * (bounds.upper - bounds.lower) / 2)
    slower = replace(
        bounds, velocity=velocity, acceleration=np.minimum(bounds.acceleration, highest * velocity)
    )
    own = bound_within(slower, 1)
    return whole, own if own.upper < whole.upper else whole


def _loaded(information: Information) -> None:
    """Compile what a search runs, or load it where that was done before.

    After an installation it takes seconds, which are no part of a design's.
    """
    rest = np.zeros((1, information.model.n_joints))
    information.state_gradient(
        rest, rest, rest, information.rows(rest, rest, rest), np.eye(information.n_parameters)
    )
    inverse_dynamics(information.model, rest, rest, rest)
    torque_derivatives(information.model, rest, rest, rest)


def position_of(base: BaseParameters, name: str) -> int:
    """Return the position of a base parameter among all, by name or id.

    Raises UsageError where there is none.
    """
    text = name.strip()
    if text in base.names:
        return base.names.index(text)
    if text.isdigit() and int(text) in base.ids:
        return int(np.flatnonzero(base.ids == int(text))[0])
    raise UsageError(
        f"{base.robot} has no base parameter {text!r}; there are:"
        f" {', '.join(f'{i} {n}' for i, n in zip(base.ids, base.names, strict=True))}"
    )


def _other_duration(
    search: DesignSearch, options: DesignOptions, motion: Motion
) -> tuple[str, ...]:
    """Say where poses take another time than was asked for."""
    more, share = search.family.size_name, motion.duration / options.duration
    if abs(share - 1.0) < SAME_DURATION:
        return ()
    cure = f"more {more} fill the time" if share < 1.0 else f"fewer {more} take less"
    return (
        (
            f"as fast as the limits allow, the {more} take {motion.duration:.3g} s, not the"
            f" {options.duration:g} s asked for; {cure}"
        ),
    )


def _told_power(
    model: RobotModel, options: DesignOptions, states: tuple[Array, Array, Array]
) -> tuple[str, ...]:
    if not options.power:
        return ()
    limit = limit_array(options.power, model.n_joints, "power")
    used = np.zeros(model.n_joints)
    used[np.isfinite(limit)] = np.abs(PowerLimit(model, limit).values(*states)).max(axis=0)
    k = int(np.argmax(used))
    return (
        (
            f"power at most {used[k] * limit[k]:.3g} W of the {limit[k]:g} W allowed, by"
            f" {model.joint_names[k]}"
        ),
    )


def _told_refinement(
    progress: Callable[[SearchProgress], None], best: float, state: SearchProgress
) -> None:
    progress(replace(state, best=max(best, state.best), phase="refinement"))


def _checked_prior(prior: Array | None, base: BaseParameters) -> Array | None:
    if prior is None:
        return None
    given = np.asarray(prior, dtype=np.float64)
    if given.shape != (base.n_base, base.n_base):
        raise UsageError(
            f"earlier information about {base.n_base} base parameters must have shape"
            f" ({base.n_base}, {base.n_base}), got {given.shape}; use the same drive terms as the"
            " earlier identification"
        )
    return given
