"""Designs for the iiwa 7 (20 s, 5 harmonics, 21 drive columns) against random search,
finite-difference SLSQP and CMA-ES at equal time times cores.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.excitation.design.design import choose_size, design_motion
from asbuilt.excitation.design.design_options import DesignOptions
from asbuilt.excitation.design.designed_motion import DesignProgram, Objective
from asbuilt.excitation.information.information import (
    DOptimality,
    Information,
    mean_information,
    parameter_scale,
)
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.excitation.state_constraint import TorqueLimit
from asbuilt.executor import count_cores

ROBOT, DURATION, HARMONICS, FRACTION, TORQUE_FRACTION = "kuka-iiwa7-r800", 20.0, 5, 0.95, 0.8
RANDOM_MOTIONS = 1000


class Problem:
    """The same objective and limits for every method, at the same nodes.

    A method is judged by what holds at 1 kHz.
    """

    def __init__(self) -> None:
        self.model = load_robot(ROBOT)
        base = find_base_parameters(self.model, DriveSet.parse(DesignOptions.drive))
        self.information, self.bounds = (
            Information.of(self.model, base),
            MotionBounds.assumed(self.model, FRACTION),
        )
        self.options = DesignOptions(
            duration=DURATION, size=HARMONICS, fraction=FRACTION, torque_fraction=TORQUE_FRACTION
        )
        self.family = choose_size(self.options, self.bounds)[1]
        torque = TorqueLimit((self.model,), TORQUE_FRACTION * MotionBounds.of(self.model).torque)
        scale = parameter_scale(self.information, self.bounds)
        objective = Objective(
            self.information, DOptimality(), scale, DURATION * self.options.information_rate
        )
        self.nodes = DesignProgram(objective, self.family, self.bounds, 200, (torque,))
        self.fine = DesignProgram(
            objective, self.family, self.bounds, int(1000 * DURATION), (torque,)
        )
        self.middle = np.outer(self.family.constant, (self.bounds.lower + self.bounds.upper) / 2)
        self.shape = self.middle.shape

    def log_det(self, coefficients: Array) -> float:
        """log det per sample on the fine grid, the motion drawn inwards until it holds there."""
        part = 0.0
        while part < 0.9:
            trial = coefficients + part * (self.middle - coefficients)
            if self.fine.smallest_margin(trial) >= 0:
                mean = mean_information(self.information, *self.fine.states(trial))
                return float(np.linalg.slogdet(mean)[1])
            part = 1.25 * part + 1e-3
        return -np.inf

    def cost(self, x: Array) -> float:
        """Minus the objective."""
        value = self.nodes.evaluate(*self.nodes.states(x.reshape(self.shape))).value
        return -value if np.isfinite(value) else 1e4

    def slack(self, x: Array) -> Array:
        """The smallest slack of each group of limits and joint."""
        return np.concatenate(
            [slack.min(axis=1).ravel() for slack in self.nodes.margins(x.reshape(self.shape))]
        )

    def random(self, seed: int) -> Array:
        """A random feasible series."""
        motion = random_fourier(
            self.model, rng=seed, duration=DURATION, n_harmonics=HARMONICS, fraction=TORQUE_FRACTION
        )
        return np.array(motion.coefficients)


class _OverError(Exception):
    pass


def slsqp(problem: Problem, seconds: float) -> Array:
    """SLSQP with finite differences from random starts until the time is over.

    The best feasible point seen.
    """
    end, best, value = time.monotonic() + seconds, problem.random(0), np.inf

    def watched(x: Array) -> float:
        nonlocal best, value
        if time.monotonic() > end:
            raise _OverError
        cost = problem.cost(x)
        if cost < value and problem.slack(x).min() >= -1e-6:
            best, value = x.reshape(problem.shape).copy(), cost
        return cost

    seed = 0
    try:
        while True:
            limits = {"type": "ineq", "fun": problem.slack}
            minimize(
                watched,
                problem.random(seed).ravel(),
                method="SLSQP",
                constraints=[limits],
                options={"maxiter": 1000, "ftol": 1e-8},
            )
            seed += 1
    except _OverError:
        return best


def cma_es(problem: Problem, seconds: float) -> Array:
    """CMA-ES with a penalty on violated limits."""
    import cma  # noqa: PLC0415

    end, start = time.monotonic() + seconds, problem.random(0)

    def penalised(x: Array) -> float:
        return problem.cost(x) + 1e3 * float(np.maximum(-problem.slack(x), 0.0).sum())

    strategy = cma.CMAEvolutionStrategy(start.ravel(), 0.1, {"verbose": -9, "seed": 1})
    while time.monotonic() < end and not strategy.stop():
        points = strategy.ask()
        strategy.tell(points, [penalised(x) for x in points])
    return np.array(strategy.result.xbest).reshape(problem.shape)


def measure(search_s: float = 240.0) -> dict[str, float | str]:
    """Return log det per sample of every method, and the D-efficiency of each relative to the best
    known; `search_s` is what a long search may take [s].
    """
    problem = Problem()
    design_motion(
        problem.model,
        DesignOptions(duration=4.0, size=3, starts=1),
        with_bound=False,
    )
    begin = time.perf_counter()
    design = design_motion(problem.model, problem.options)
    seconds = time.perf_counter() - begin
    p = design.base.n_base
    found = {"design": float(np.linalg.slogdet(design.mean_information)[1])}
    begin = time.perf_counter()
    random = [problem.random(k) for k in range(RANDOM_MOTIONS)]
    found["random_1000"] = max(
        float(np.linalg.slogdet(mean_information(problem.information, *problem.fine.states(c)))[1])
        for c in random
    )
    random_seconds = time.perf_counter() - begin
    methods: dict[str, Callable[[Problem, float], Array]] = {"slsqp": slsqp, "cma": cma_es}
    with use_one_blas_thread():
        for name, method in methods.items():
            found[name] = problem.log_det(method(problem, seconds * count_cores()))
    patient = replace(problem.options, seed=1, starts=10**4, time_limit=search_s)
    search = design_motion(problem.model, patient, with_bound=False)
    found["long_search"] = float(np.linalg.slogdet(search.mean_information)[1])
    best = max(found.values())
    numbers: dict[str, float | str] = {
        "design_s": seconds,
        "random_1000_s": random_seconds,
        "long_search_s": search_s,
    }
    numbers |= {f"log_det_per_sample_{name}": value for name, value in found.items()}
    numbers |= {
        f"d_efficiency_of_{name}_against_the_best": float(np.exp((value - best) / p))
        for name, value in found.items()
    }
    numbers |= {
        "d_efficiency_against_the_bound": float(design.d_efficiency or 0.0),
        "d_efficiency_against_the_bound_of_5_harmonics": float(design.family_efficiency or 0.0),
        "condition_number": design.condition_number,
        "scaled_condition_number": design.scaled_condition_number,
        "worst_margin": min(
            margin for margin in design.limits.worst_margin.values() if margin is not None
        ),
    }
    return numbers
