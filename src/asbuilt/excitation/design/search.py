"""Local searches for the best motion.

From random starts, from disturbed good motions, and refined until all limits hold at 1 kHz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation.design.interior_point import StateConstraint, solve
from asbuilt.excitation.design.multistart import (
    Candidate,
    Deadline,
    SearchProgress,
    best_first,
    search_all,
)
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.design.process_pool import Crew
from asbuilt.excitation.design.program import DesignProgram, Objective
from asbuilt.excitation.design.torque_limit import (
    STANDING,
    PowerLimit,
    TorqueLimit,
    WeightLimit,
    perturbed_models,
)
from asbuilt.excitation.information.information import mean_information
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion, limit_array
from asbuilt.excitation.motions.pacing import CHECK_RATE, paced_moves
from asbuilt.excitation.motions.parametrisations import Parametrisation, PointToPoint
from asbuilt.excitation.state_bounds import random_states

NODES_PER_WAVE = 40
"""Nodes per shortest wave of a motion during the search, twice as many in the end.

With fewer, a search hides motion between the nodes.
"""

LEAST_NODES = 128
"""Nodes of the search at least, however few waves a motion has."""
SEARCH_BARRIER = (20.0, 3e-3)
"""Weights of the barrier at the beginning and the end of a search from a random start.

Strong at first, which takes it away from the limits that it began near.
"""
FINAL_BARRIER = (3e-3, 3e-5)
"""The same for the refinement, which goes on where the search ended."""
HOP_BARRIER = (0.3, 3e-3)
"""The same for a search from a disturbed good motion, which is not to be driven away from it."""
SEARCH_SPARE, FINAL_SPARE = (3e-3, 3e-2), (1e-3, 1e-2)
"""What search and refinement leave of the limits of motion and of the other constraints, so that
they hold between the nodes, too.
"""

POPULATION = 24
"""Random starts of a population. Disturbing its best goes on until that brings nothing.

Then a new one begins, for populations end in optima of different worth.
"""

GENERATION = 8
"""Disturbed motions searched from at a time.

All of a generation have the same parents, whatever the number of cores.
"""

PARENTS = 3
"""Best motions of a population that are disturbed."""
HOPS_PER_START = 8
"""Disturbed motions searched from at most, for each random start."""
IDLE_GENERATIONS = 8
LEAST_GAIN = 0.02
"""A population ends after so many generations in a row that raise the best value by less than this."""
DISTURBANCE = (0.1, 0.5)
"""How far, in parts of the way to a random motion, a good one is disturbed."""

REPAIRS = 12
"""Attempts to make a motion hold at 1 kHz,"""
LEAST_SHRINKING, MOST_SHRINKING = 0.005, 0.3
"""in each of which it shrinks towards a point, poses by the least part to begin with.

Beyond the most a motion is given up.
"""
SURVEYED = 200
"""Random poses that tell whether a robot is anywhere too heavy for its drives."""

SHORTEST_MOVE = 0.1
"""Least time that the design grants to a move between two poses [s]."""


@dataclass(frozen=True, eq=False)
class Task:
    """Ask for a search.

    Number `number` begins at a random start of its own, or between that and a good motion `origin`;
    with `refined_until`, the deadline, `origin` itself is refined on a grid twice as dense and made
    to hold at 1 kHz.
    """

    number: int
    origin: Candidate | None = None
    refined_until: Deadline | None = None


class DesignSearch:
    """Local searches from random starts, and the refinement of what they find."""

    def __init__(
        self,
        model: RobotModel,
        objective: Objective,
        options: DesignOptions,
        constraints: tuple[StateConstraint, ...],
        deadline: Deadline,
    ) -> None:
        self.family = options.family
        self._model, self._objective, self._options, self._deadline = (
            model,
            objective,
            options,
            deadline,
        )
        self._bounds = MotionBounds.assumed(model, options.fraction)
        torque = options.torque_fraction * MotionBounds.of(model).torque
        models = perturbed_models(
            model, options.perturbed, options.spread, np.random.default_rng([options.seed, 1 << 20])
        )
        watch: tuple[StateConstraint, ...] = (
            (TorqueLimit(models, torque),) if np.any(np.isfinite(torque)) else ()
        )
        if watch and isinstance(self.family, PointToPoint):
            weight = WeightLimit(models, STANDING * torque)
            poses = random_states(self._bounds, SURVEYED, np.random.default_rng(0))[0]
            watch += (weight,) if weight.binds(poses) else ()
        if options.power:
            watch += (PowerLimit(model, limit_array(options.power, model.n_joints, "power")),)
        self._constraints = watch + constraints
        span = self.family.duration / getattr(self.family, "periods", 1)
        self._n_nodes = max(LEAST_NODES, round(NODES_PER_WAVE * span / self.family.shortest_wave))
        self._coarse = self._program(self._n_nodes, SEARCH_SPARE)

    def _program(
        self, n_nodes: int, spare: tuple[float, float], family: Parametrisation | None = None
    ) -> DesignProgram:
        return DesignProgram(
            self._objective, family or self.family, self._bounds, n_nodes, self._constraints, *spare
        )

    def run(
        self, crew: Crew[Task, Candidate] | None, progress: Callable[[SearchProgress], None] | None
    ) -> list[Candidate]:
        """Return the candidates, best first, of all populations that the deadline leaves time for."""
        starts = self._options.starts
        sizes = [POPULATION] * (starts // POPULATION) + (
            [starts % POPULATION] if starts % POPULATION else []
        )
        lengths = [
            size + GENERATION * math.ceil(HOPS_PER_START * size / GENERATION) for size in sizes
        ]
        found: list[Candidate] = []
        first = 0
        for size, length in zip(sizes, lengths, strict=True):
            if found and self._deadline():
                break
            best = found[0].value if found else -np.inf
            told = partial(self._told, progress, best, sum(lengths))
            found = best_first([*found, *self._population(first, size, length, crew, told)])
            first += length
        return found

    def _population(
        self,
        first: int,
        size: int,
        length: int,
        crew: Crew[Task, Candidate] | None,
        told: Callable[[int, float, SearchProgress], None],
    ) -> list[Candidate]:
        """Return the candidates of one population, best first.

        Searches from random starts, then from disturbed versions of the best so far.

        Disturbing good motions (basin hopping, Wales & Doye 1997) goes on, a generation at a time,
        until some generations bring nothing. The searches of a population are numbered from
        `first`.
        """
        seeds = [Task(first + k) for k in range(size)]
        found = search_all(
            seeds, self.search, self._deadline, crew=crew, progress=partial(told, first, -np.inf)
        )
        idle, done = 0, size
        while found and done < length and idle < IDLE_GENERATIONS and not self._deadline():
            best = found[0].value
            parents = found[:PARENTS]
            hops = [Task(first + done + k, parents[k % len(parents)]) for k in range(GENERATION)]
            born = search_all(
                hops,
                self.search,
                self._deadline,
                crew=crew,
                progress=partial(told, first + done, best),
            )
            found = best_first([*found, *born])
            idle = idle + 1 if found[0].value < best + LEAST_GAIN else 0
            done += GENERATION
        return found

    @staticmethod
    def _told(
        progress: Callable[[SearchProgress], None] | None,
        best: float,
        planned: int,
        before: int,
        own_best: float,
        state: SearchProgress,
    ) -> None:
        if progress is not None:
            progress(
                replace(
                    state,
                    finished=before + state.finished,
                    planned=planned,
                    best=max(best, own_best, state.best),
                )
            )

    def search(self, task: Task) -> Candidate:
        """Do what a task asks for; the answer depends on nothing else."""
        if task.refined_until is not None:
            assert task.origin is not None
            return self._refined(task.origin, task.refined_until)
        rng = np.random.default_rng([self._options.seed, task.number])
        return (
            self._from_seed(task.number, rng)
            if task.origin is None
            else self._from_parent(task.number, rng, task.origin)
        )

    def _from_seed(self, number: int, rng: np.random.Generator) -> Candidate:
        start = self._start(rng)
        optimum = (
            None
            if start is None
            else solve(self._coarse, start, barrier=SEARCH_BARRIER, cancelled=self._deadline)
        )
        return Candidate.of(number, optimum)

    def _from_parent(self, number: int, rng: np.random.Generator, parent: Candidate) -> Candidate:
        for _ in range(10):
            other = self._start(rng)
            if other is None:
                break
            part = rng.uniform(*DISTURBANCE)
            start = self._inside(self._coarse, (1 - part) * parent.coefficients + part * other)
            if start is not None:
                optimum = solve(self._coarse, start, barrier=HOP_BARRIER, cancelled=self._deadline)
                if optimum is not None:
                    return Candidate.of(number, optimum)
        return Candidate.of(number, None)

    def _refined(self, candidate: Candidate, deadline: Deadline) -> Candidate:
        coefficients, family, value = candidate.coefficients, self.family, candidate.value
        for _ in range(2 if isinstance(family, PointToPoint) else 1):
            family = self._retimed(family, coefficients)
            dense = self._program(2 * self._n_nodes, FINAL_SPARE, family)
            start = self._inside(dense, coefficients)
            optimum = (
                None
                if start is None
                else solve(dense, start, barrier=FINAL_BARRIER, cancelled=deadline)
            )
            if optimum is not None and (
                optimum.value > value - 1.0 or isinstance(family, PointToPoint)
            ):
                coefficients, value = optimum.coefficients, optimum.value
        kept = self._repaired(coefficients, family)
        if kept is None:
            return Candidate.of(candidate.number, None)
        if isinstance(family, PointToPoint):
            moved = self._paced(kept)
            assert moved is not None
            return Candidate(
                candidate.number,
                kept,
                self._objective.value(mean_information(self._objective.information, *moved)),
            )
        return Candidate(candidate.number, kept, dense.evaluate(*dense.states(kept)).value)

    def _paced(self, poses: Array) -> tuple[Array, Array, Array] | None:
        """Return the states at 1 kHz of what a controller makes of the poses, None where it can
        make nothing.
        """
        motion = paced_moves(poses, self._bounds, self._constraints)
        return None if motion is None else motion.at(motion.sample_times(CHECK_RATE))

    def motion(self, candidate: Candidate) -> Motion:
        """Return the motion of a refined candidate.

        Poses become what a controller makes of them, slowed down on moves whose torque asks for it.
        """
        if not isinstance(self.family, PointToPoint):
            return self.family.motion(candidate.coefficients)
        motion = paced_moves(candidate.coefficients, self._bounds, self._constraints)
        if motion is None:
            raise MotionError(
                f"{self._model.name}: the designed poses ask for too much torque, however slow;"
                " allow a larger share of it"
            )
        return motion

    def _retimed(self, family: Parametrisation, poses: Array) -> Parametrisation:
        if not isinstance(family, PointToPoint):
            return family
        way = np.abs(np.diff(poses, axis=0))
        steps = np.max(
            [1.5 * way / self._bounds.velocity, np.sqrt(4.5 * way / self._bounds.acceleration)],
            axis=(0, 2),
        )
        return family.retimed(np.maximum(steps, SHORTEST_MOVE))

    def failure(self) -> MotionError:
        """Return why there is no design."""
        rng = np.random.default_rng([self._options.seed, 0])
        start = self._start(rng)
        if start is None:
            return MotionError(
                f"{self._model.name}: no motion within the constraints was found to start from,"
                " however small; check the torque limits, the obstacles and the box of the tool,"
                " or raise the fraction of the limits that may be used"
            )
        return MotionError(
            f"{self._model.name}: no {self.family.key} motion with {self.family.size}"
            f" {self.family.size_name} tells all {self._objective.information.n_parameters} base"
            f" parameters; ask for more {self.family.size_name} or fewer drive terms"
        )

    def _start(self, rng: np.random.Generator) -> Array | None:
        program, n = self._coarse, self._model.n_joints
        constant = self.family.constant
        for _ in range(40):
            shape = self.family.random(rng, n)
            shape -= np.outer(constant, constant @ shape / (constant @ constant))
            size = np.max(
                [
                    np.abs(basis @ shape / half).max(axis=0)
                    for basis, half in zip(program.bases, program.half, strict=True)
                ],
                axis=0,
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
        """Return the coefficients drawn towards standing in the middle of the range or of the
        motion, just enough to be strictly feasible.
        """
        own = np.outer(self.family.constant, (program.bases[0] @ coefficients).mean(axis=0))
        middle = np.outer(self.family.constant, (self._bounds.lower + self._bounds.upper) / 2)
        for part in (0.0, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2):
            for pose in (middle, own):
                inner: Array = coefficients + part * (pose - coefficients)
                if min(float(slack.min()) for slack in program.margins(inner)) > 1e-6:
                    return inner
        return None

    def _repaired(self, coefficients: Array, family: Parametrisation) -> Array | None:
        """Return the coefficients, drawn inwards until every constraint holds at 1 kHz, at the pace
        that a controller gives them.
        """
        span = family.duration / getattr(family, "periods", 1)
        grid = self._program(max(self._n_nodes, int(span * CHECK_RATE)), (0.0, 0.0), family)
        middle = np.outer(family.constant, (self._bounds.lower + self._bounds.upper) / 2)
        own = np.outer(family.constant, (grid.bases[0] @ coefficients).mean(axis=0))
        for pose in (middle, own):
            part = 0.0
            for _ in range(REPAIRS):
                trial: Array = coefficients + part * (pose - coefficients)
                if isinstance(family, PointToPoint):
                    worst = -LEAST_SHRINKING if self._paced(trial) is None else 0.0
                else:
                    worst = min(float(slack.min()) for slack in grid.margins(trial))
                if worst >= 0:
                    return trial
                part = max(2 * part, -1.05 * worst, 1e-6)
                if part > MOST_SHRINKING:
                    break
        return None
