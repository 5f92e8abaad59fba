"""Position servo of a robot from its commands: stiffness, damping and delay."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, PositionServo, find_base_parameters
from asbuilt.errors import UsageError
from asbuilt.experiment import Recording, SignalChain
from asbuilt.experiment.command.magnitude import MagnitudeLaw, fit_logged_magnitude_laws
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.findings import Cure
from asbuilt.identification.bodies.cad_prior import CadPrior, build_cad_prior
from asbuilt.identification.information.equations import Equations
from asbuilt.identification.information.rows import TimeBlock
from asbuilt.identification.servo.deviations import (
    GoalLimit,
    average_limits,
    estimate_deadband,
    fill_unknown,
    find_goal_limit,
)
from asbuilt.identification.servo.servo_fits import (
    DelayFit,
    ServoScale,
    average_slopes,
    find_scale,
    fit_delay,
)
from asbuilt.identification.servo.servo_replay import Replay, replay
from asbuilt.identification.servo.servo_rows import (
    CommandedMotion,
    ServoErrors,
    reduce_servo_recordings,
)
from asbuilt.identification.uncertainty.pose_noise import MeanScores, with_equation_noise

UNEXPLAINED = 3.0
"""Residual of a second, in residuals of the median second, from which the model lacks its cause:
a collision, or a limit of the servo. Residuals of friction stay below."""


@dataclass(frozen=True, slots=True, eq=False)
class ServoEstimate:
    """Hold an identified servo with its errors, and the time blocks that it does not explain.

    `goals` are the limits of the acceleration of its goal that the recordings show, None for one
    that shows none. The servo has a limit if all of them show one. `slopes` are how the torque
    follows the delay. `currents` are the laws of magnitudes that were logged with the commands,
    one per joint, empty if none were. `expected` is what does not average out of the recordings,
    None if the replay that measures it diverged.
    """

    servo: PositionServo
    errors: ServoErrors
    unexplained: tuple[TimeBlock, ...] = ()
    goals: tuple[GoalLimit | None, ...] = ()
    slopes: MeanScores | None = None
    currents: tuple[MagnitudeLaw | None, ...] = ()
    expected: MeanScores | None = None

    def of_recording(self, number: int) -> PositionServo:
        """Return the servo with the limit of its goal in one of the recordings."""
        # A limit that was stated holds for every recording; one that was sought may act in some
        # alone.
        limit = _read_limit(self.goals[number])
        servo = self.servo
        found = np.where(self.errors.goal_sought, limit, servo.goal_acceleration)
        return replace(servo, goal_acceleration=tuple(found.tolist()))

    @property
    def precedes_command(self) -> bool:
        """Whether the torque precedes its command by three standard errors, which no delay does."""
        error = self.errors.delay
        # 1e-3: time [s] by which a torque may precede its command for reasons of sampling.
        return bool(error > 0.0 and (self.servo.delay or 0.0) + 3.0 * error < -1e-3)


def _read_limit(goal: GoalLimit | None) -> float:
    return np.inf if goal is None else goal.acceleration


def _refuse_stiffness(model: RobotModel, servo: PositionServo, shared: bool) -> None:
    """Raise `UsageError` where no stiffness is above zero, or reactions mix unknown ones."""
    unknown = np.isnan(servo.kp)
    if not np.any(servo.kp):
        raise UsageError(
            f"the stiffness of the position servo of {model.name} is 0 at every joint, so that no"
            " command moves it; expected N m/rad above 0",
            cure=Cure("state the stiffness that the servos have", {"kp": "LIST"}),
            value=0.0,
        )
    driven = unknown[model.driven_joints]
    if model.has_reactions and unknown.any() and not (shared and driven.all()):
        raise UsageError(
            f"{model.name} touches the ground, whose forces mix the joints, so that a stiffness of"
            f" each ({int(unknown.sum())} are unknown) does not follow from commands",
            cure=Cure(
                "state the gains, or that all joints have one stiffness", {"same_servos": True}
            ),
        )


def estimate_servo(
    model: RobotModel,
    recordings: Sequence[Recording],
    drive: DriveSet,
    chain: SignalChain,
    *,
    delay: float | None = None,
    shared: bool = False,
    holdout: str | None = None,
    filters: MotionFilters | None = None,
) -> ServoEstimate:
    """Identify what is unknown of the servo that all recordings have.

    Noise of the positions and friction at reversals, which do not average out, are measured by a
    replay of the recordings (`replay`) and taken away.

    Parameters
    ----------
    model
        The robot, whose masses by design give an unknown stiffness its scale.
    recordings
        Recordings with commands and the same servo.
    drive
        Linear drive terms.
    chain
        The signal chain, its cutoff settled.
    delay
        Time [s] by which the torque follows the command; None: identified.
    shared
        Whether all unknown stiffnesses are one.
    holdout
        A rule of `hold_out`: what to leave out.
    filters
        What filters motions, once for all who share it; None: of its own.
    """
    stated = recordings[0].servo
    if stated is None:
        raise ValueError("the recordings have no servo")
    base = find_base_parameters(model, drive)
    design = build_cad_prior(model, drive)
    unknown = np.isnan(np.array(stated.kp))
    late = 0.0 if delay is None else delay
    _refuse_stiffness(model, stated, shared)

    filters = filters or MotionFilters()
    driven = [drive_by_command(recording, stated) for recording in recordings]
    samples = [filters.prepare(recording, chain).samples() for recording in driven]
    # An unknown stiffness leaves the noise of the equations without a unit.
    noise = samples if unknown.any() else with_equation_noise(model, samples)
    motions = [
        CommandedMotion(model, base, recording, chain, holdout, filters, noise[0].reactions.noise)
        for recording in recordings
    ]

    def goal_of(motion: CommandedMotion, recording: Recording) -> GoalLimit | None:
        # With no limit: the limited goal is what is searched, and the delay's column need not
        # follow it.
        plain = replace(recording, servo=fill_unknown(stated, goal_acceleration=np.inf))
        rate = functools.cache(lambda: motion.rate(plain, late))

        def rows(servo: PositionServo) -> Equations:
            return reduce_servo_recordings(
                [motion], [replace(recording, servo=servo)], late, [rate()]
            )

        reached = np.max(np.abs(motion.motion.samples().qdd), axis=0)
        return find_goal_limit(recording, stated, reached, rows)

    goals = tuple(map(goal_of, motions, recordings))
    with_goals = [fill_unknown(stated, goal_acceleration=_read_limit(goal)) for goal in goals]
    limited = [
        replace(recording, servo=servo)
        for recording, servo in zip(recordings, with_goals, strict=True)
    ]
    dead, dead_error = estimate_deadband(motions, limited, late)
    driven = [
        replace(recording, servo=fill_unknown(servo, deadband=dead))
        for recording, servo in zip(recordings, with_goals, strict=True)
    ]
    at, replayed = _settle_servo(
        design,
        motions,
        driven,
        fill_unknown(stated, deadband=dead),
        late,
        free_delay=delay is None,
        shared=shared,
    )
    scale = at.scale
    excess = at.found.excess
    limit, limit_error = average_limits(goals)
    errors = np.zeros(model.n_joints) if scale is None else np.where(unknown, scale.std_errors, 0.0)
    sources = ("given",) * model.n_joints if scale is None else scale.source
    return ServoEstimate(
        fill_unknown(at.servo, goal_acceleration=limit),
        ServoErrors(
            kp=tuple(errors.tolist()),
            delay=at.error,
            goal_acceleration=limit_error,
            deadband=dead_error,
            goal_sought=tuple(np.isnan(np.array(stated.goal_acceleration)).tolist()),
            shared=scale is not None and scale.shared,
            scale=tuple(np.where(unknown, sources, "given").tolist()),
            kd_unknown=tuple(np.isnan(np.array(stated.kd)).tolist()),
        ),
        tuple(
            block
            for block, ratio in zip(at.rows.blocks, excess, strict=True)
            if ratio > UNEXPLAINED
        ),
        goals,
        average_slopes(at.rows, base, (excess <= UNEXPLAINED).tolist(), at.kp),
        fit_logged_magnitude_laws(driven),
        None if replayed is None else replayed.scores,
    )


# Say when the delay has settled: at most so many steps, each below `SERVO_CONVERGENCE` [s].
#
# The recordings are replayed so many times, each with the servo that followed from the last.

SERVO_MOST = 12
SERVO_REPLAYS = 2
SERVO_CONVERGENCE = 2e-5
SERVO_LONGEST = 0.2


USUAL_SLOPES = (0.3, 3.0)
"""Range of the slope by which steps fall per delay, 1 if they lead to the best one at once."""


@dataclass(frozen=True, slots=True, eq=False)
class _Settled:
    """Hold a servo with the standard error of its delay, and the fit that it rests on.

    `kp` (n,) multiply the signals of the rows: stiffnesses, or 1 where the rows hold them.
    """

    servo: PositionServo
    error: float
    rows: Equations
    scale: ServoScale | None
    found: DelayFit
    kp: tuple[float, ...]


def _settle_servo(
    design: CadPrior,
    motions: Sequence[CommandedMotion],
    recordings: Sequence[Recording],
    servo: PositionServo,
    late: float,
    *,
    free_delay: bool,
    shared: bool,
) -> tuple[_Settled, Replay | None]:
    """Return servo and fit from a first delay [s], and the last replay; None if it diverged.

    Each replay moves the robot and servo found before, with physically consistent links: a fit
    without bounds may have others.

    Parameters
    ----------
    design
        CAD.
    motions, recordings
        Recordings with the servo that each had, but for its gains and delay.
    servo
        What is stated or was found of the servo; an unknown stiffness is NaN.
    free_delay
        Whether the delay is identified.
    shared
        Whether all unknown stiffnesses are one.
    """
    motion = motions[0]
    replayed = None
    at = _alternate(design, motions, recordings, servo, late, None, free_delay, shared)
    # Replays before the last only move the start: one pair of noise is enough for them.
    for last in (False,) * (SERVO_REPLAYS - 1) + (True,):
        # Smallest eigenvalue of the inertia of a link that is replayed, in CAD's: own choice.
        links = design.made_consistent(at.found.parameters, 0.1)
        replayed = replay(
            motion.model,
            motion.base,
            recordings,
            at.servo,
            motion.chain,
            links,
            motion.holdout,
            roughly=not last,
        )
        if replayed is None:
            # A robot that diverges under its own commands measures nothing; the last fit stands.
            break
        late = at.servo.delay or 0.0
        at = _alternate(design, motions, recordings, servo, late, replayed, free_delay, shared)
    return at, replayed


def _alternate(
    design: CadPrior,
    motions: Sequence[CommandedMotion],
    recordings: Sequence[Recording],
    servo: PositionServo,
    late: float,
    replayed: Replay | None,
    free_delay: bool,
    shared: bool,
) -> _Settled:
    """Return the gains and the delay that are found in turn from a start."""
    model = motions[0].model
    base = motions[0].base
    unknown = np.isnan(np.array(servo.kp))
    kd = np.nan_to_num(np.array(servo.kd)).tolist()
    error = 0.0
    before: tuple[float, float] | None = None
    for _ in range(SERVO_MOST):
        rows = reduce_servo_recordings(motions, recordings, late)
        kp = np.array(servo.kp)
        scale = None
        if np.any(unknown):
            # The scale is that of the links: drives are free columns of their own.
            links = design.parameters.copy()
            links[10 * model.n_links :] = 0.0
            # Signals that are projected are multiplied by their gains already.
            own_kd = (1.0,) * unknown.size if model.has_reactions else servo.kd
            scale = find_scale(rows, base, links, own_kd, unknown, shared=shared)
            # An undetermined stiffness has an infinite error; any finite value lets the fit go on.
            kp = np.where(unknown, np.where(np.isfinite(scale.kp), scale.kp, 1.0), kp)
        gains = kp.tolist(), kd
        if model.has_reactions:
            gains = np.where(unknown, kp, 1.0).tolist(), [1.0] * len(kd)
        doubt = _doubt_ratios(scale, unknown)
        found = fit_delay(rows, base, design, *gains, doubt, replayed)
        if not free_delay:
            break
        # The fit is linear about this delay, and is made again where it leads.
        step = _take_secant_step(late, found.step, before)
        error = found.std_error
        before = late, found.step
        late = float(np.clip(late + step, -SERVO_LONGEST, SERVO_LONGEST))
        # Closer than a twentieth of its own error no delay is known.
        if abs(step) < max(SERVO_CONVERGENCE, 0.05 * error):
            break
    # A fit of one robot to all joints knows their ratios; the scale of all stays that of CAD.
    kp = kp * found.ratios
    settled = replace(servo, kp=tuple(kp.tolist()), kd=tuple(kd), delay=late)
    return _Settled(settled, error, rows, scale, found, tuple(gains[0]))


def _doubt_ratios(scale: ServoScale | None, unknown: Mask) -> Array:
    """Return the relative standard error (n,) of each stiffness beside the others', 0 if known.

    Servos of one stiffness have a known ratio; others are determined, each by CAD.
    """
    if scale is None or scale.shared:
        return np.zeros(unknown.size)
    return np.where(unknown, scale.std_errors / scale.kp, 0.0)


def _take_secant_step(late: float, step: float, before: tuple[float, float] | None) -> float:
    """Return how far from a delay its best one lies, by the steps there and at the delay before.

    Steps overshoot, or fall short, by an about constant factor. Without a delay before, or where
    that factor is not usual, it is the step itself.
    """
    if before is None or late == before[0]:
        return step
    # Secant on step(delay): the best delay is where the step vanishes.
    slope = (step - before[1]) / (late - before[0])
    return -step / slope if -USUAL_SLOPES[1] < slope < -USUAL_SLOPES[0] else step
