"""Design a motion: the most informative one that the robot may make."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.admissible import limited_model, parameter_scale
from asbuilt.excitation.criteria import criterion_of
from asbuilt.excitation.design_program import DesignProgram, Objective
from asbuilt.excitation.information import Information, mean_information
from asbuilt.excitation.information_bound import InformationBound, information_bound
from asbuilt.excitation.interior_point import StateConstraint, solve
from asbuilt.excitation.limits import LimitReport, MotionBounds, check_motion
from asbuilt.excitation.motion import Array, Motion, limit_array
from asbuilt.excitation.multistart import Candidate, Deadline, SearchProgress, search_all
from asbuilt.excitation.parametrisations import PARAMETRISATIONS, Fourier, Parametrisation, PointToPoint
from asbuilt.excitation.point_to_point import PointToPointMotion
from asbuilt.excitation.torque_limit import PowerLimit, TorqueLimit, perturbed_models

USUAL_DRIVE = DriveSet.parse("viscous,coulomb,offset")

NODES_PER_WAVE = 40
"""Nodes per shortest wave of a motion during the search, twice as many in the end; with fewer, a search hides motion between the nodes."""

LEAST_NODES = 128
SEARCH_BARRIER = (20.0, 3e-3)
FINAL_BARRIER = (3e-3, 3e-5)
HOP_BARRIER = (0.3, 3e-3)
SEARCH_SPARE, FINAL_SPARE = (3e-3, 3e-2), (1e-3, 1e-2)
"""What search and refinement leave of the limits of motion and of the other constraints, so that they hold between the nodes, too."""

POLISHED = 4
"""How many of the best local optima are refined on the dense grid."""

SEARCH_SHARE = 0.7
LEAST_SHARE = 0.15
"""How the time limit is shared between the search and the refinement of what it finds."""

GENERATION = 8
"""Disturbed motions searched from at a time: all of a generation have the same parents, whatever the number of cores."""

PARENTS = 3
HOPS_PER_START = 8
IDLE_GENERATIONS = 8
LEAST_GAIN = 0.02
DISTURBANCE = (0.1, 0.5)

REPAIRS = 12
SLOWING = 0.93
MOST_SHRINKING = 0.3
SHORTEST_MOVE = 0.1
"""Least time that the design grants to a move between two poses [s]."""

CHECK_RATE = 1000.0


@dataclass(frozen=True)
class DesignOptions:
    """Say what is wanted of a design.

    | field | meaning |
    |---|---|
    | `parametrisation`, `size` | family of motions and how rich it is: harmonics, control points or way points |
    | `duration`, `periods` | length of the motion [s]; a Fourier series may run through several periods |
    | `criterion`, `focus` | `d`, `a`, `e` or `condition`; names or ids of base parameters for D_s |
    | `noise` | standard deviation of the torque [N m or N], one number or one per joint |
    | `information_rate` | independent torque samples per second that the noise refers to [1/s] |
    | `fraction`, `torque_fraction` | how much of the limits of motion, and of torque, may be used |
    | `power` | greatest mechanical power of each joint [W], one number or one per joint; none where empty |
    | `perturbed`, `spread` | how many other robots the torque limit must hold for, and how far off their masses are |
    | `starts`, `seed`, `time_limit` | local searches, seed of everything random, and when to be done [s] |
    """

    parametrisation: str = "fourier"
    size: int | None = None
    duration: float = 20.0
    periods: int = 1
    criterion: str = "d"
    focus: tuple[str, ...] = ()
    noise: float | tuple[float, ...] = 1.0
    information_rate: float = 100.0
    fraction: float = 0.95
    torque_fraction: float = 0.8
    power: tuple[float, ...] = ()
    perturbed: int = 0
    spread: float = 0.1
    starts: int = 24
    seed: int = 0
    time_limit: float = 25.0

    def __post_init__(self) -> None:
        if self.parametrisation not in PARAMETRISATIONS:
            raise UsageError(f"unknown parametrisation {self.parametrisation!r}; available: {', '.join(PARAMETRISATIONS)}")
        for name in ("duration", "information_rate", "time_limit"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name} must be a positive number, got {value}")
        for name in ("fraction", "torque_fraction"):
            if not 0 < getattr(self, name) <= 1:
                raise UsageError(f"{name} must lie above 0 and at most at 1, got {getattr(self, name)}")
        for name in ("starts", "periods"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.size is not None and self.size < 2:
            raise UsageError(f"a design needs at least 2 harmonics, 3 way points or control points; got {self.size}")

    @property
    def family(self) -> Parametrisation:
        """The family of motions."""
        if self.parametrisation == "fourier":
            size = self.size or usual_harmonics(self.duration / self.periods)
            return Fourier(self.duration, size, self.periods)
        size = self.size or max(4, round(self.duration / 1.25) + 1)
        return PARAMETRISATIONS[self.parametrisation](self.duration, size)


def usual_harmonics(period: float) -> int:
    """Return the number of harmonics where none is asked for: up to a quarter of a hertz, at least 3."""
    return max(3, round(0.25 * period))


@dataclass(frozen=True, eq=False)
class Design:
    """Hold a designed motion and what it is worth.

    `mean_information` (p, p) is `Y^T S^-1 Y` averaged over a 1 kHz grid, with exact drive columns; `log_det` refers to `n_samples` independent
    samples. `limits` are the margins on that grid (limits that the description lacks are those of `MotionBounds.assumed`, named in
    `assumed`), `collision_distance` the smallest distance there [m], None where nothing was watched.
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
        """`exp((log det M - log det M_bound) / p)` per sample: the share of the attainable information, None where no bound was found."""
        return None if self.bound is None else self.bound.efficiency(self.mean_information)

    @property
    def family_efficiency(self) -> float | None:
        """The same against the smaller bound for motions with these harmonics; None for other families."""
        return None if self.family_bound is None else self.family_bound.efficiency(self.mean_information)

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
        """Predicted standard errors of the base parameters (p,), from this motion and what was known before."""
        total = self.information if self.prior is None else self.information + self.prior
        size = 1.0 / np.sqrt(np.diag(total))
        errors: Array = size * np.sqrt(np.diag(np.linalg.inv(total * np.outer(size, size))))
        return errors


def design_motion(
    model: RobotModel,
    drive: DriveSet = USUAL_DRIVE,
    options: DesignOptions | None = None,
    *,
    prior: Array | None = None,
    constraints: Sequence[StateConstraint] = (),
    base: BaseParameters | None = None,
    with_bound: bool = True,
    threads: int | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> Design:
    """Return the best motion that several local searches find within the limits.

    `prior` (p, p) is information about the base parameters from earlier recordings; `constraints` are watched besides position, velocity,
    acceleration, jerk and torque. A keyboard interrupt ends the search and keeps the best motion so far.

    Raises
    ------
    MotionError
        If no start within the constraints is found, or no motion of the family tells all parameters.
    """
    wanted = options or DesignOptions()
    found = base or find_base_parameters(model, drive)
    information = Information.of(model, found, wanted.noise if isinstance(wanted.noise, float) else np.array(wanted.noise))
    focus = [position_of(found, name) for name in wanted.focus] or None
    scale = parameter_scale(information, MotionBounds.assumed(model, wanted.fraction))
    objective = Objective(
        information, criterion_of(wanted.criterion, focus), scale, wanted.duration * wanted.information_rate, _checked_prior(prior, found)
    )
    begin = time.monotonic()
    bound, family_bound = design_bounds(model, information, wanted) if with_bound else (None, None)
    deadline = Deadline(max(SEARCH_SHARE * wanted.time_limit - (time.monotonic() - begin), LEAST_SHARE * wanted.time_limit))
    search = _Search(model, objective, wanted, tuple(constraints), deadline)
    candidates = search.run(threads, progress)
    if not candidates:
        raise search.failure()
    final = Deadline(0.0 if deadline.interrupted else max(wanted.time_limit - (time.monotonic() - begin), LEAST_SHARE * wanted.time_limit))
    polished = search_all(
        [search.refined(candidate, final) for candidate in candidates[:POLISHED]], Deadline(np.inf), threads=threads, progress=None
    )
    if not polished:
        raise MotionError(
            f"{model.name}: the motions found do not hold between the nodes of the search; ask for more time, or for fewer {search.family.size_name}"
        )
    best = polished[0]
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
        seconds=time.monotonic() - begin,
        interrupted=deadline.interrupted,
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
) -> Design:
    """Return what a motion is worth, evaluated at 1 kHz with exact drive columns, and its margins there."""
    limited, assumed = limited_model(model)
    t = (np.arange(max(1, int(motion.duration * CHECK_RATE))) + 0.5) * motion.duration / max(1, int(motion.duration * CHECK_RATE))
    mean = mean_information(objective.information, *motion.at(t))
    distances = [constraint.smallest_distance(motion.at(t)[0]) for constraint in constraints if hasattr(constraint, "smallest_distance")]
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
    )


def design_bounds(model: RobotModel, information: Information, options: DesignOptions) -> tuple[InformationBound, InformationBound | None]:
    """Return the bound over all states within the limits, and the one over those that a Fourier series with these harmonics can reach.

    A series whose highest frequency is w obeys `|qd| <= w r` and `|qdd| <= w max |qd|`, r half the range of q (Bernstein 1912).
    """
    bounds, family = MotionBounds.assumed(model, options.fraction), options.family
    torque = options.torque_fraction * MotionBounds.of(model).torque
    whole = information_bound(model, information, bounds, torque=torque, seed=options.seed)
    if not isinstance(family, Fourier):
        return whole, None
    highest = 2 * np.pi / family.shortest_wave
    velocity = np.minimum(bounds.velocity, highest * (bounds.upper - bounds.lower) / 2)
    slower = replace(bounds, velocity=velocity, acceleration=np.minimum(bounds.acceleration, highest * velocity))
    return whole, information_bound(model, information, slower, torque=torque, seed=options.seed)


def position_of(base: BaseParameters, name: str) -> int:
    """Return the position of a base parameter among all, by name or id; raises UsageError where there is none."""
    text = name.strip()
    if text in base.names:
        return base.names.index(text)
    if text.isdigit() and int(text) in base.ids:
        return int(np.flatnonzero(base.ids == int(text))[0])
    raise UsageError(
        f"{base.robot} has no base parameter {text!r}; there are: {', '.join(f'{i} {n}' for i, n in zip(base.ids, base.names, strict=True))}"
    )


def _checked_prior(prior: Array | None, base: BaseParameters) -> Array | None:
    if prior is None:
        return None
    given = np.asarray(prior, dtype=np.float64)
    if given.shape != (base.n_base, base.n_base):
        raise UsageError(
            f"earlier information about {base.n_base} base parameters must have shape ({base.n_base}, {base.n_base}), got {given.shape}; "
            "use the same drive terms as the earlier identification"
        )
    return given


class _Search:
    """Local searches from random starts, and the refinement of what they find."""

    def __init__(
        self, model: RobotModel, objective: Objective, options: DesignOptions, constraints: tuple[StateConstraint, ...], deadline: Deadline
    ) -> None:
        self.family = options.family
        self._model, self._objective, self._options, self._deadline = model, objective, options, deadline
        self._bounds = MotionBounds.assumed(model, options.fraction)
        torque = options.torque_fraction * MotionBounds.of(model).torque
        models = perturbed_models(model, options.perturbed, options.spread, np.random.default_rng([options.seed, 1 << 20]))
        watch: tuple[StateConstraint, ...] = (TorqueLimit(models, torque),) if np.any(np.isfinite(torque)) else ()
        if options.power:
            watch += (PowerLimit(model, limit_array(options.power, model.n_joints, "power")),)
        self._constraints = watch + constraints
        span = self.family.duration / getattr(self.family, "periods", 1)
        self._n_nodes = max(LEAST_NODES, round(NODES_PER_WAVE * span / self.family.shortest_wave))
        self._coarse = self._program(self._n_nodes, SEARCH_SPARE)

    def _program(self, n_nodes: int, spare: tuple[float, float], family: Parametrisation | None = None) -> DesignProgram:
        return DesignProgram(self._objective, family or self.family, self._bounds, n_nodes, self._constraints, *spare)

    def run(self, threads: int | None, progress: Callable[[SearchProgress], None] | None) -> list[Candidate]:
        """Return the candidates, best first: searches from random starts, then from disturbed versions of the best so far.

        Disturbing good motions (basin hopping, Wales & Doye 1997) goes on, a generation at a time, until some generations bring nothing.
        """
        starts = self._options.starts
        planned = starts + GENERATION * math.ceil(HOPS_PER_START * starts / GENERATION)

        def told(state: SearchProgress, before: int, best: float) -> None:
            if progress is not None:
                progress(SearchProgress(state.seconds, before + state.finished, planned, max(best, state.best)))

        found = search_all(
            [self.from_seed(k) for k in range(starts)], self._deadline, threads=threads, progress=partial(told, before=0, best=-np.inf)
        )
        idle, done = 0, starts
        while found and done < planned and idle < IDLE_GENERATIONS and not self._deadline():
            best = found[0].value
            parents = found[:PARENTS]
            hops = [self.from_parent(done + k, parents[k % len(parents)]) for k in range(GENERATION)]
            before = done
            born = search_all(hops, self._deadline, threads=threads, progress=partial(told, before=before, best=best))
            found = sorted([*found, *born], key=lambda candidate: (-candidate.value, candidate.number))
            idle = idle + 1 if found[0].value < best + LEAST_GAIN else 0
            done += GENERATION
        return found

    def from_parent(self, number: int, parent: Candidate) -> Callable[[], Candidate]:
        """Return the search number `number`, which begins between a parent and a random start."""

        def search() -> Candidate:
            rng = np.random.default_rng([self._options.seed, number])
            for _ in range(10):
                other = self._start(rng)
                if other is None:
                    break
                part = rng.uniform(*DISTURBANCE)
                start = self._inside(self._coarse, (1 - part) * parent.coefficients + part * other)
                if start is not None:
                    optimum = solve(self._coarse, start, barrier=HOP_BARRIER, cancelled=self._deadline)
                    if optimum is not None:
                        return Candidate(number, optimum.coefficients, optimum.value)
            return Candidate(number, np.zeros((0, 0)), -np.inf)

        return search

    def from_seed(self, number: int) -> Callable[[], Candidate]:
        """Return the search number `number`."""

        def search() -> Candidate:
            rng = np.random.default_rng([self._options.seed, number])
            start = self._start(rng)
            optimum = None if start is None else solve(self._coarse, start, barrier=SEARCH_BARRIER, cancelled=self._deadline)
            if optimum is None:
                return Candidate(number, np.zeros((0, 0)), -np.inf)
            return Candidate(number, optimum.coefficients, optimum.value)

        return search

    def refined(self, candidate: Candidate, deadline: Deadline) -> Callable[[], Candidate]:
        """Return the refinement of a candidate on a grid twice as dense, made to hold at 1 kHz."""

        def search() -> Candidate:
            coefficients, family, value = candidate.coefficients, self.family, candidate.value
            for _ in range(2 if isinstance(family, PointToPoint) else 1):
                family = self._retimed(family, coefficients)
                dense = self._program(2 * self._n_nodes, FINAL_SPARE, family)
                start = self._inside(dense, coefficients)
                optimum = None if start is None else solve(dense, start, barrier=FINAL_BARRIER, cancelled=deadline)
                if optimum is not None and (optimum.value > value - 1.0 or isinstance(family, PointToPoint)):
                    coefficients, value = optimum.coefficients, optimum.value
            kept = self._repaired(coefficients, family)
            if kept is None:
                return Candidate(candidate.number, coefficients, -np.inf)
            return Candidate(candidate.number, kept, dense.value(*dense.states(kept)))

        return search

    def motion(self, candidate: Candidate) -> Motion:
        """Return the motion of a refined candidate; poses become what a controller makes of them, slowed down where a torque limit asks for it."""
        if not isinstance(self.family, PointToPoint):
            return self.family.motion(candidate.coefficients)
        factor = 1.0
        for _ in range(REPAIRS):
            motion = PointToPointMotion.within(
                candidate.coefficients, velocity=factor * self._bounds.velocity, acceleration=factor**2 * self._bounds.acceleration
            )
            states = motion.at(motion.sample_times(CHECK_RATE))
            values = [(constraint.two_sided, constraint.values(*states)) for constraint in self._constraints]
            if all(v.max() < 1 and (not both or v.min() > -1) for both, v in values):
                return motion
            factor *= SLOWING
        raise MotionError(f"{self._model.name}: at full speed the designed poses ask for too much torque; allow a larger share of it")

    def _retimed(self, family: Parametrisation, poses: Array) -> Parametrisation:
        if not isinstance(family, PointToPoint):
            return family
        way = np.abs(np.diff(poses, axis=0))
        steps = np.max([1.5 * way / self._bounds.velocity, np.sqrt(4.5 * way / self._bounds.acceleration)], axis=(0, 2))
        return family.retimed(np.maximum(steps, SHORTEST_MOVE))

    def failure(self) -> MotionError:
        """Return why there is no design."""
        rng = np.random.default_rng([self._options.seed, 0])
        start = self._start(rng)
        if start is None:
            return MotionError(
                f"{self._model.name}: no motion within the constraints was found to start from, however small; "
                "check the torque limits, the obstacles and the box of the tool, or raise the fraction of the limits that may be used"
            )
        return MotionError(
            f"{self._model.name}: no {self.family.key} motion with {self.family.size} {self.family.size_name} tells all "
            f"{self._objective.information.n_parameters} base parameters; ask for more {self.family.size_name} or fewer drive terms"
        )

    def _start(self, rng: np.random.Generator) -> Array | None:
        program, n = self._coarse, self._model.n_joints
        constant = self.family.constant
        for _ in range(40):
            shape = self.family.random(rng, n)
            shape -= np.outer(constant, constant @ shape / (constant @ constant))
            size = np.max(
                [np.abs(basis @ shape / half).max(axis=0) for basis, half in zip(program.bases, program.half, strict=True)], axis=0
            )
            shape *= rng.uniform(0.3, 0.8, size=n) / size
            path = program.bases[0] @ shape
            low, high = self._bounds.lower - path.min(axis=0), self._bounds.upper - path.max(axis=0)
            pose = low + rng.uniform(0.1, 0.9, size=n) * (high - low)
            for _ in range(6):
                coefficients = shape + np.outer(constant, pose)
                if min(float(slack.min()) for slack in program.margins(coefficients)) > 1e-6:
                    return coefficients
                shape = 0.6 * shape
        return None

    def _inside(self, program: DesignProgram, coefficients: Array) -> Array | None:
        """Return the coefficients drawn towards standing in the middle of the range or of the motion, just enough to be strictly feasible."""
        own = np.outer(self.family.constant, (program.bases[0] @ coefficients).mean(axis=0))
        middle = np.outer(self.family.constant, (self._bounds.lower + self._bounds.upper) / 2)
        for part in (0.0, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2):
            for pose in (middle, own):
                inner: Array = coefficients + part * (pose - coefficients)
                if min(float(slack.min()) for slack in program.margins(inner)) > 1e-6:
                    return inner
        return None

    def _repaired(self, coefficients: Array, family: Parametrisation) -> Array | None:
        """Return the coefficients, drawn inwards until every constraint holds at 1 kHz."""
        span = family.duration / getattr(family, "periods", 1)
        grid = self._program(max(self._n_nodes, int(span * CHECK_RATE)), (0.0, 0.0), family)
        middle = np.outer(family.constant, (self._bounds.lower + self._bounds.upper) / 2)
        own = np.outer(family.constant, (grid.bases[0] @ coefficients).mean(axis=0))
        for pose in (middle, own):
            part = 0.0
            for _ in range(REPAIRS):
                trial: Array = coefficients + part * (pose - coefficients)
                worst = min(float(slack.min()) for slack in grid.margins(trial))
                if worst >= 0:
                    return trial
                part = max(2 * part, -1.05 * worst, 1e-6)
                if part > MOST_SHRINKING:
                    break
        return None
