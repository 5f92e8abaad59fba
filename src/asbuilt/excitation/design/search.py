"""Local searches for the best motion, with restarts and refinement at 1 kHz."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.design.design_options import DesignOptions
from asbuilt.excitation.design.designed_motion import DesignProgram, Objective
from asbuilt.excitation.design.interior_point import Optimum, solve
from asbuilt.excitation.design.multistart import (
    Deadline,
    SearchPool,
    SearchProgress,
    rank_optima,
    search_all,
)
from asbuilt.excitation.information.information import draw_states, mean_information
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion, check_limit_array
from asbuilt.excitation.motions.parametrisation import Parametrisation
from asbuilt.excitation.motions.point_to_point import CHECK_RATE, PointToPoint, pace_moves
from asbuilt.excitation.state_constraint import (
    STANDING,
    PowerLimit,
    StateConstraint,
    TorqueLimit,
    WeightLimit,
    perturb_models,
)

# Configure the local searches; values found by experiments with six arms.

SEARCH_NODES_PER_WAVE = 40  # Nodes per shortest wave, twice as many in the end; fewer hide motion
SEARCH_LEAST_NODES = 128  # Fewest nodes
# Barrier weights from a random start, strong to leave nearby limits
SEARCH_BARRIER_RANDOM = (20.0, 3e-3)
SEARCH_BARRIER_RESTART = (0.3, 3e-3)  # Barrier weights from a disturbed optimum
SEARCH_BARRIER_REFINED = (3e-3, 3e-5)  # Barrier weights of the refinement
# SEARCH_MARGIN_COARSE, SEARCH_MARGIN_FINE: margins to the limits of motion and to other constraints
SEARCH_MARGIN_COARSE = (3e-3, 3e-2)
SEARCH_MARGIN_FINE = (1e-3, 1e-2)
SEARCH_ROUND = 24  # Random starts of a round; rounds end in optima of different value
SEARCH_BATCH = 8  # Restarts from the same parents, whatever the number of cores
SEARCH_PARENTS = 3  # Best optima that are disturbed
SEARCH_RESTARTS_PER_START = 8  # Most restarts for each random start
# SEARCH_IDLE_BATCHES, SEARCH_LEAST_GAIN: a round ends after so many batches that gain less than
# this
SEARCH_IDLE_BATCHES = 8
SEARCH_LEAST_GAIN = 0.02
SEARCH_DISTURBANCE = (0.1, 0.5)  # Fraction of the way to a random motion that a restart goes
# SEARCH_REPAIRS, SEARCH_SHRINKAGE: attempts to hold the limits at 1 kHz; least and most shrinking
SEARCH_REPAIRS = 12
SEARCH_SHRINKAGE = (0.005, 0.3)
SEARCH_ITERATIONS = 400  # Most iterations of a local search; those of arms end after 5 to 25
# Fewest iterations for which a local search is worth its start
SEARCH_FEWEST_ITERATIONS = 60
# Work of all searches for each random start, in nodes times joints times parameters: some 1.2 s,
# of which arms of seven joints need a fifth. Robots of 30 joints get fewer searches by it.
SEARCH_WORK = 4e7
SEARCH_REFINED = 4  # Number of best local optima refined on the dense grid
# Work of the refinement, in random starts; each of them makes some 100 iterations
SEARCH_REFINED_STARTS = 8
SEARCH_POSES = 200  # Random poses that show whether the robot is too heavy for its drives
SEARCH_SHORTEST_MOVE = 0.1  # Least time of a move between two poses [s]


@dataclass(frozen=True, eq=False)
class Task:
    """Ask for search `number`: from a random start, or from one disturbing the optimum `origin`.

    With a deadline `refined_until`, `origin` itself is refined on a grid twice as dense and made to
    hold the limits at 1 kHz. The search makes `iterations` at most.
    """

    number: int
    origin: Optimum | None = None
    refined_until: Deadline | None = None
    iterations: int = SEARCH_ITERATIONS


def share_iterations(tasks: list[Task], iterations: int) -> list[Task]:
    """Return the first tasks for which so many iterations suffice, at least one, and their shares.

    Shares depend on nothing that another machine would do otherwise.
    """
    count = min(len(tasks), max(1, iterations // SEARCH_FEWEST_ITERATIONS))
    each = min(SEARCH_ITERATIONS, max(SEARCH_FEWEST_ITERATIONS, iterations // count))
    return [replace(task, iterations=each) for task in tasks[:count]]


class DesignSearch:
    """Local searches from random starts, and the refinement of what they find."""

    def __init__(
        self,
        objective: Objective,
        options: DesignOptions,
        family: Parametrisation,
        constraints: tuple[StateConstraint, ...],
        deadline: Deadline,
    ) -> None:
        model = objective.information.model
        self.family = family
        self._model = model
        self._objective = objective
        self._options = options
        self._deadline = deadline
        self._bounds = MotionBounds.assumed(model, options.fraction)
        torque = options.torque_fraction * MotionBounds.of(model).torque
        models = perturb_models(
            # Its own stream, so that the number of starts does not change the other robots.
            model,
            options.perturbed,
            options.spread,
            np.random.default_rng([options.seed, 1 << 20]),
        )
        limits: tuple[StateConstraint, ...] = (
            (TorqueLimit(models, torque),) if np.any(np.isfinite(torque)) else ()
        )
        if limits and isinstance(self.family, PointToPoint):
            weight = WeightLimit(models, STANDING * torque)
            # A fixed seed: whether a robot is too heavy does not depend on the options.
            poses = draw_states(self._bounds, SEARCH_POSES, np.random.default_rng(0))[0]
            limits += (weight,) if weight.binds(poses) else ()
        if options.power:
            limits += (
                PowerLimit(model, check_limit_array(options.power, model.n_joints, "power")),
            )
        self._constraints = limits + constraints
        # Fewer nodes than the shortest wave needs would hide motion between them.
        waves = SEARCH_NODES_PER_WAVE * family.span / family.shortest_wave
        self._n_nodes = max(SEARCH_LEAST_NODES, round(waves))
        self._coarse = self._build_program(self._n_nodes, SEARCH_MARGIN_COARSE)
        # A count, and no time: a busy machine finds the same motion, later.
        state = model.n_joints * objective.information.n_parameters
        work = self._n_nodes * (state + model.joint_map.work)
        self._iterations = round(options.starts * SEARCH_WORK / work)
        self._refinement = round(SEARCH_REFINED_STARTS * SEARCH_WORK / work)
        # Random starts, and most searches with their restarts. Rounds end by themselves, so that a
        # long search tries other regions.
        starts = options.starts
        sizes = [min(SEARCH_ROUND, starts - k) for k in range(0, starts, SEARCH_ROUND)]
        restarts = [math.ceil(SEARCH_RESTARTS_PER_START * size / SEARCH_BATCH) for size in sizes]
        self._rounds = [
            (size, size + SEARCH_BATCH * batches)
            for size, batches in zip(sizes, restarts, strict=True)
        ]

    def _build_program(
        self, n_nodes: int, margin: tuple[float, float], family: Parametrisation | None = None
    ) -> DesignProgram:
        chosen = family or self.family
        return DesignProgram(
            self._objective, chosen, self._bounds, n_nodes, self._constraints, *margin
        )

    def run(
        self,
        pool: SearchPool[Task, Optimum | None] | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> list[Optimum]:
        """Return the candidates, best first, of all rounds for which work and time are left."""
        found: list[Optimum] = []
        first = 0
        for size, length in self._rounds:
            # Something must be found before work or time may end the search.
            if found and self._is_over:
                break
            best = found[0].value if found else -np.inf
            found = rank_optima(
                [*found, *self._run_round(first, size, length, best, pool, progress)]
            )
            first += length
        return found

    def _run_round(
        self,
        first: int,
        size: int,
        length: int,
        best_before: float,
        pool: SearchPool[Task, Optimum | None] | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> list[Optimum]:
        """Return the candidates of one round, best first; its searches are numbered from `first`.

        Random starts, then restarts from disturbed optima (basin hopping, Wales & Doye 1997) in
        batches, until some batches in a row bring no gain.
        """
        tasks = [Task(first + k) for k in range(size)]
        found = self._search_tasks(tasks, best_before, pool, progress)
        idle = 0
        done = size
        while found and done < length and idle < SEARCH_IDLE_BATCHES and not self._is_over:
            best = found[0].value
            parents = found[:SEARCH_PARENTS]
            # The best parents in turn, whatever the number of cores: results do not depend on it.
            tasks = [Task(first + done + k, parents[k % len(parents)]) for k in range(SEARCH_BATCH)]
            restarted = self._search_tasks(tasks, max(best, best_before), pool, progress)
            found = rank_optima([*found, *restarted])
            # One gain starts the patience anew.
            idle = idle + 1 if found[0].value < best + SEARCH_LEAST_GAIN else 0
            done += SEARCH_BATCH
        return found

    @property
    def _is_over(self) -> bool:
        """Whether no work is left for another search, or no time."""
        return self._iterations < SEARCH_FEWEST_ITERATIONS or self._deadline()

    def _search_tasks(
        self,
        tasks: list[Task],
        best: float,
        pool: SearchPool[Task, Optimum | None] | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> list[Optimum]:
        """Return the candidates, best first, of the tasks for which there is work left.

        `best` is the value of the best candidate before.
        """
        planned = sum(length for _, length in self._rounds)

        def report(state: SearchProgress) -> None:
            assert progress is not None
            finished = tasks[0].number + state.finished
            highest = max(best, state.best)
            progress(replace(state, finished=finished, planned=planned, best=highest))

        found = search_all(
            share_iterations(tasks, self._iterations),
            self.search,
            self._deadline,
            pool=pool,
            progress=report if progress else None,
        )
        self._iterations -= sum(candidate.iterations for candidate in found)
        return found

    def refine(
        self,
        candidates: list[Optimum],
        deadline: Deadline,
        pool: SearchPool[Task, Optimum | None] | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> list[Optimum]:
        """Return the best of the candidates refined, best first, with the work that is left.

        Local optima are of nearly equal value: refined, another one may be best.
        """
        tasks = [Task(found.number, found, deadline) for found in candidates[:SEARCH_REFINED]]
        # An iteration on twice as many nodes is twice the work.
        left = max(self._iterations, 0) + self._refinement
        shared = share_iterations(tasks, left // 2)
        refined = search_all(shared, self.search, deadline, pool=pool, progress=progress)
        others = tasks[len(shared) :]
        if refined or not others:
            return refined
        # None of these holds its limits between the nodes: the next ones may.
        others = [replace(task, iterations=SEARCH_FEWEST_ITERATIONS) for task in others]
        return search_all(others, self.search, deadline, pool=pool, progress=progress)

    def search(self, task: Task) -> Optimum | None:
        """Return the optimum of a task, which depends on nothing else, if there is one."""
        if task.refined_until is not None:
            assert task.origin is not None
            return self._refine(task.origin, task.refined_until, task.iterations)
        # By seed and number: a task gives the same anywhere.
        rng = np.random.default_rng([self._options.seed, task.number])
        if task.origin is not None:
            optimum = self._restart(task, rng, task.origin)
        else:
            start = self._draw_start(rng)
            optimum = self._solve(self._coarse, start, SEARCH_BARRIER_RANDOM, task.iterations)
        return None if optimum is None else replace(optimum, number=task.number)

    def _solve(
        self,
        program: DesignProgram,
        start: Array | None,
        barrier: tuple[float, float],
        iterations: int,
        deadline: Deadline | None = None,
    ) -> Optimum | None:
        if start is None:
            return None
        cancelled = deadline or self._deadline
        return solve(
            program, start, barrier=barrier, most_iterations=iterations, cancelled=cancelled
        )

    def _restart(self, task: Task, rng: np.random.Generator, parent: Optimum) -> Optimum | None:
        for _ in range(10):
            other = self._draw_start(rng)
            if other is None:
                break
            part = rng.uniform(*SEARCH_DISTURBANCE)
            # Between two motions limits may be broken: shrunk until they hold.
            start = self._shrink_inside(
                self._coarse, (1 - part) * parent.coefficients + part * other
            )
            optimum = self._solve(self._coarse, start, SEARCH_BARRIER_RESTART, task.iterations)
            if optimum is not None:
                return optimum
        return None

    def _refine(self, candidate: Optimum, deadline: Deadline, iterations: int) -> Optimum | None:
        coefficients = candidate.coefficients
        family = self.family
        value = candidate.value
        # Poses change their times with the refinement, which then starts again.
        for _ in range(2 if isinstance(family, PointToPoint) else 1):
            family = self._retime(family, coefficients)
            dense = self._build_program(2 * self._n_nodes, SEARCH_MARGIN_FINE, family)
            start = self._shrink_inside(dense, coefficients)
            optimum = self._solve(dense, start, SEARCH_BARRIER_REFINED, iterations, deadline)
            # An optimum that is worse on the dense grid was one of the coarse grid alone.
            if optimum is not None and (
                optimum.value > value - 1.0 or isinstance(family, PointToPoint)
            ):
                coefficients = optimum.coefficients
                value = optimum.value
        kept = self._repair(coefficients, family)
        if kept is None:
            return None
        if isinstance(family, PointToPoint):
            # A controller's motion through the poses decides, not the search's nodes.
            moved = self._pace(kept)
            assert moved is not None
            value = self._objective.value(mean_information(self._objective.information, *moved))
        else:
            value = dense.evaluate(*dense.states(kept)).value
        return Optimum(kept, value, number=candidate.number)

    def _pace(self, poses: Array) -> tuple[Array, Array, Array] | None:
        """Return the states at 1 kHz of a controller's motion through the poses, if it has one."""
        motion = pace_moves(poses, self._bounds, self._constraints)
        return None if motion is None else motion.at(motion.sample_times(CHECK_RATE))

    def motion(self, candidate: Optimum) -> Motion:
        """Return the motion of a refined candidate; poses are joined as a controller does.

        Moves whose torque is too large are slowed down.
        """
        if not isinstance(self.family, PointToPoint):
            return self.family.motion(candidate.coefficients)
        motion = pace_moves(candidate.coefficients, self._bounds, self._constraints)
        if motion is None:
            raise MotionError(
                f"{self._model.name}: the designed poses exceed the torque limits at any speed;"
                " allow a larger share of the torque"
            )
        return motion

    def _retime(self, family: Parametrisation, poses: Array) -> Parametrisation:
        if not isinstance(family, PointToPoint):
            return family
        way = np.abs(np.diff(poses, axis=0))
        steps = np.max(
            # Quintics reach 1.5 of the mean velocity and some 4.5 of the mean acceleration over the
            # time.
            [1.5 * way / self._bounds.velocity, np.sqrt(4.5 * way / self._bounds.acceleration)],
            axis=(0, 2),
        )
        return family.retimed(np.maximum(steps, SEARCH_SHORTEST_MOVE))

    def failure(self) -> MotionError:
        """Return the error that says why there is no design."""
        start = self._draw_start(np.random.default_rng([self._options.seed, 0]))
        if start is None:
            return MotionError(
                f"{self._model.name}: no motion within the constraints was found, however small;"
                " check torque limits, obstacles and the box of the tool, or allow a larger"
                " fraction of the limits"
            )
        return MotionError(
            f"{self._model.name}: no {self.family.key} motion with {self.family.size}"
            f" {self.family.size_name} determines all {self._objective.information.n_parameters}"
            f" base parameters; use more {self.family.size_name} or fewer drive terms"
        )

    def _draw_start(self, rng: np.random.Generator) -> Array | None:
        program = self._coarse
        n = self._model.n_joints
        constant = self.family.constant
        for _ in range(40):
            shape = self.family.random(rng, n)
            # Without its constant part, which the pose is for.
            shape -= np.outer(constant, constant @ shape / (constant @ constant))
            # The joint's largest use of any limit, so that the start may be scaled to a share of
            # it.
            size = np.max(
                [
                    np.abs(basis @ shape / half).max(axis=0)
                    for basis, half in zip(program.bases, program.half, strict=True)
                ],
                axis=0,
            )
            shape *= rng.uniform(0.3, 0.8, size=n) / size
            path = program.bases[0] @ shape
            # Poses at which the whole path keeps its range.
            low = self._bounds.lower - path.min(axis=0)
            high = self._bounds.upper - path.max(axis=0)
            pose = low + rng.uniform(0.1, 0.9, size=n) * (high - low)
            for _ in range(6):
                coefficients = shape + np.outer(constant, pose)
                if program.smallest_margin(coefficients) > 1e-6:
                    return coefficients
                # State constraints are broken by size more often than by place.
                shape = 0.6 * shape
        return None

    def _shrink_inside(self, program: DesignProgram, coefficients: Array) -> Array | None:
        """Return the coefficients shrunk towards the middle of the range or of the motion.

        They shrink just enough to be strictly feasible.
        """
        # As little as needed: shrinking gives information away.
        for part in (0.0, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2):
            for pose in self._list_centres(program, coefficients):
                inner: Array = coefficients + part * (pose - coefficients)
                if program.smallest_margin(inner) > 1e-6:
                    return inner
        return None

    def _list_centres(self, program: DesignProgram, coefficients: Array) -> list[Array]:
        """Return coefficients of rest at the middle of the range and at the mean of the motion."""
        middle = (self._bounds.lower + self._bounds.upper) / 2
        mean = (program.bases[0] @ coefficients).mean(axis=0)
        return [np.outer(self.family.constant, pose) for pose in (middle, mean)]

    def _repair(self, coefficients: Array, family: Parametrisation) -> Array | None:
        """Return the coefficients, shrunk until every constraint holds at 1 kHz."""
        grid = self._build_program(
            max(self._n_nodes, int(family.span * CHECK_RATE)), (0.0, 0.0), family
        )
        least, most = SEARCH_SHRINKAGE
        for pose in self._list_centres(grid, coefficients):
            part = 0.0
            for _ in range(SEARCH_REPAIRS):
                trial: Array = coefficients + part * (pose - coefficients)
                if isinstance(family, PointToPoint):
                    worst = -least if self._pace(trial) is None else 0.0
                else:
                    worst = grid.smallest_margin(trial)
                # Strictly nothing: refined motions hold the limits at 1 kHz.
                if worst >= 0:
                    return trial
                # At least as far as the worst constraint asks, and twice as far as before.
                part = max(2 * part, -1.05 * worst, 1e-6)
                if part > most:
                    break
        return None
