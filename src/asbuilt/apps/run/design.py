"""Design of the motion of a round: where the model is least certain and it matters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import asbuilt
from asbuilt import AsbuiltError, DesignOptions, RobotModel, Study, UsageError, writers
from asbuilt.apps.run.options import RunOptions
from asbuilt.apps.run.purpose import States, weigh_parameters
from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation import Motion, check_motion, measure_clearance
from asbuilt.identification import known_information

STARTS = 6
"""Random starts of a design; the best of six has 95 % of the information of the best of 96."""
TIME_LIMIT = 20.0
"""Time of a design [s]; the starts end before it, so that the motion is the same everywhere."""
FREQUENCY = 0.25
"""Highest frequency of random motions [Hz], as of `random_fourier` by default."""
ATTEMPTS = 20
"""Random motions that are tried until no bodies touch."""
SLOWER = 1.1
"""Factor by which a motion is slowed while it exceeds the torque limits of the robot as built."""
MOST_SLOWED = 20
"""How often that is tried: by then it is 7 times slower, and only gravity is left."""


def design_round(
    model: RobotModel,
    study: Study | None,
    options: RunOptions,
    number: int,
    states: States,
    weights: Array | None,
    goal: Motion | None = None,
    *,
    as_goal: bool = False,
) -> Motion:
    """Return the motion of a round, within every limit.

    The first is small and slow and determines all parameters alike. One that moves `as_goal` is
    `goal`, the user's motion, or a random one over the whole range. Each further one has the least
    `tr(A C)` with what is known, A the cost of parameter errors for the purpose, in which joints
    count by `weights` (n,).

    Raises
    ------
    MotionError
        If no motion within the limits is found.
    """
    wanted = DesignOptions(
        duration=options.seconds,
        fraction=options.speed if number == 1 else options.fraction,
        collision=options.collision,
        starts=STARTS,
        time_limit=TIME_LIMIT,
        seed=options.seed + number,
    )
    if study is None:
        return _design(model, wanted)
    if as_goal:
        usual = _choose_goal_motion(model, options, number, goal)
        if usual is not None:
            return _slow_down(study, usual)
    result = study.result
    share = np.ones(model.n_joints) if weights is None else weights
    purpose = weigh_parameters(result, states, options.purpose, share**2)
    sigma = result.sigma
    finite = np.where(np.isfinite(sigma), sigma, np.max(sigma[np.isfinite(sigma)]))
    try:
        motion = asbuilt.design_motion(
            result.model,
            replace(wanted, noise=tuple(np.maximum(finite, 1e-9).tolist())),
            base=result.base,
            prior=known_information(result),
            purpose=purpose,
            with_bound=False,
            cores=1,
        ).motion
    except (UsageError, MotionError):
        # Terms of coupled motors have no design, and of some models no motion determines all.
        motion = _design(model, wanted)
    return _slow_down(study, motion)


def _choose_goal_motion(
    model: RobotModel, options: RunOptions, number: int, goal: Motion | None
) -> Motion | None:
    """Return the user's motion or a random one; None if bodies touch or a limit is violated."""
    if goal is not None:
        return goal if _is_allowed(model, goal, options.collision) else None
    for attempt in range(ATTEMPTS):
        motion = asbuilt.random_fourier(
            model,
            np.random.default_rng([options.seed, number, attempt]),
            duration=options.seconds,
            n_harmonics=max(2, round(FREQUENCY * options.seconds)),
            fraction=options.fraction,
        )
        if _is_allowed(model, motion, options.collision):
            return motion
    return None


def _is_allowed(model: RobotModel, motion: Motion, collision: str | None) -> bool:
    if not check_motion(model, motion).is_respected:
        return False
    if collision is None:
        return True
    try:
        measure_clearance(model, motion, collision)
    except MotionError:
        return False
    return True


def _design(model: RobotModel, wanted: DesignOptions) -> Motion:
    motion = asbuilt.design_motion(model, wanted, with_bound=False, cores=1).motion
    check_motion(model, motion).raise_if_violated()
    return motion


def _slow_down(study: Study, motion: Motion) -> Motion:
    """Return a motion as slow as the torque limits of the robot as built need it."""
    try:
        robot = writers.as_built(study.result).model
    except AsbuiltError:
        robot = study.result.model
    for times in range(MOST_SLOWED):
        slower = motion if times == 0 else motion.slowed(SLOWER**times)
        if check_motion(robot, slower).is_respected:
            return slower
    check_motion(robot, slower).raise_if_violated()
    return slower
