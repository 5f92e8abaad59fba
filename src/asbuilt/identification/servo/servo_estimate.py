"""Position servo of a robot from its commands: stiffness, damping and delay."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import UsageError
from asbuilt.experiment.command.magnitude import MagnitudeLaw, fit_logged_magnitude_laws
from asbuilt.experiment.command.servo_torque import drive_by_command
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.prepared_motion import MotionFilters
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Cure
from asbuilt.identification.bodies.cad_prior import build_cad_prior
from asbuilt.identification.errors.pose_noise import ExpectedScores, with_equation_noise
from asbuilt.identification.information.rows import TimeBlock
from asbuilt.identification.servo.deadband import estimate_deadband, with_deadband
from asbuilt.identification.servo.goal_limit import (
    GoalLimit,
    average_limits,
    find_goal_limit,
    limit_goal,
)
from asbuilt.identification.servo.servo_delay import DelaySlopes
from asbuilt.identification.servo.servo_errors import ServoErrors
from asbuilt.identification.servo.servo_rows import (
    CommandedMotion,
    ServoRows,
    reduce_servo_recordings,
)
from asbuilt.identification.servo.settling import Settling

UNEXPLAINED = 3.0
"""Residual of a second, in those of the median second, from which it has another cause than those
of the model: contact, or a limit of the servo. Residuals of friction stay below."""


@dataclass(frozen=True, slots=True, eq=False)
class ServoEstimate:
    """Hold an identified servo with its errors, and the time blocks that it does not explain.

    `goals` are the limits of the acceleration of its goal that the recordings show, None for one
    that shows none. The servo has a limit if all of them show one. `slopes` are how the torque
    follows the delay. `currents` are the laws of magnitudes that were logged beside the commands,
    one per joint, empty if none were. `expected` is what does not average out of the recordings,
    None if the replay that measures it diverged.
    """

    servo: PositionServo
    errors: ServoErrors
    unexplained: tuple[TimeBlock, ...] = ()
    goals: tuple[GoalLimit | None, ...] = ()
    slopes: DelaySlopes | None = None
    currents: tuple[MagnitudeLaw | None, ...] = ()
    expected: ExpectedScores | None = None

    def of_recording(self, number: int) -> PositionServo:
        """Return the servo with the limit of its goal in one of the recordings."""
        goal = self.goals[number]
        return limit_goal(self._sought, np.inf if goal is None else goal.acceleration)

    @property
    def precedes_command(self) -> bool:
        """Whether the torque precedes its command by three standard errors, which no delay does."""
        error = self.errors.delay
        # 1e-3: time [s] by which a torque may precede its command for reasons of sampling.
        return bool(error > 0.0 and (self.servo.delay or 0.0) + 3.0 * error < -1e-3)

    @property
    def _sought(self) -> PositionServo:
        """The servo, its limit NaN where it was sought."""
        found = np.where(self.errors.goal_sought, np.nan, self.servo.goal_acceleration)
        return replace(self.servo, goal_acceleration=tuple(found.tolist()))


def _refuse_stiffness(model: RobotModel, servo: PositionServo, shared: bool) -> None:
    """Raise `UsageError` where no stiffness is above zero, or contacts mix unknown ones."""
    unknown = np.isnan(servo.kp)
    if not np.any(servo.kp):
        raise UsageError(
            f"the stiffness of the position servo of {model.name} is 0 at every joint, so that no"
            " command moves it; expected N m/rad above 0",
            cure=Cure("state the stiffness that the servos have", {"kp": "LIST"}),
            value=0.0,
        )
    if model.contacts and unknown.any() and not (shared and unknown[model.n_floating :].all()):
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
    first = recordings[0].servo
    if first is None:
        raise ValueError("the recordings have no servo")
    base, design = find_base_parameters(model, drive), build_cad_prior(model, drive)
    unknown = np.isnan(np.array(first.kp))
    _refuse_stiffness(model, first, shared)
    stated, late = first, 0.0 if delay is None else delay

    filters = filters or MotionFilters()
    driven = [drive_by_command(each, first) for each in recordings]
    samples = [filters.prepare(each, chain).samples() for each in driven]
    noise = samples if unknown.any() else with_equation_noise(model, samples)
    motions = [
        CommandedMotion(model, base, each, chain, holdout, filters, noise[0].noise)
        for each in recordings
    ]

    def goal_of(motion: CommandedMotion, recording: Recording) -> GoalLimit | None:
        plain = replace(recording, servo=limit_goal(stated, np.inf))
        rate = functools.cache(lambda: motion.rate(plain, late))

        def rows(servo: PositionServo) -> ServoRows:
            return reduce_servo_recordings(
                [motion], [replace(recording, servo=servo)], late, [rate()]
            )

        reached = np.max(np.abs(motion.motion.samples().qdd), axis=0)
        return find_goal_limit(recording, stated, reached, rows)

    goals = tuple(map(goal_of, motions, recordings))
    recordings = [
        replace(each, servo=limit_goal(first, np.inf if goal is None else goal.acceleration))
        for each, goal in zip(recordings, goals, strict=True)
    ]
    dead = estimate_deadband(motions, recordings, late)
    stated = first = with_deadband(first, 0.0 if dead is None else dead.width)
    recordings = [
        replace(each, servo=with_deadband(each.servo, 0.0 if dead is None else dead.width))
        for each in recordings
        if each.servo is not None
    ]
    at, replayed = Settling(
        model=model,
        base=base,
        design=design,
        motions=motions,
        recordings=recordings,
        servo=stated,
        chain=chain,
        free_delay=delay is None,
        shared=shared,
        holdout=holdout,
    ).settle(late)
    scale, found = at.scale, at.found
    limit, limit_error = average_limits(goals)
    errors = np.zeros(model.n_joints) if scale is None else np.where(unknown, scale.std_errors, 0.0)
    return ServoEstimate(
        limit_goal(at.servo, limit),
        ServoErrors(
            kp=tuple(errors.tolist()),
            delay=at.error,
            goal_acceleration=limit_error,
            deadband=0.0 if dead is None else dead.std_error,
            goal_sought=tuple(bool(each) for each in np.isnan(np.array(first.goal_acceleration))),
            shared=scale is not None and scale.shared,
            scale=tuple(
                "given" if scale is None or not each else name
                for each, name in zip(
                    unknown, ("",) * len(unknown) if scale is None else scale.source, strict=True
                )
            ),
            kd_unknown=tuple(bool(each) for each in np.isnan(np.array(first.kd))),
        ),
        tuple(
            block
            for block, excess in zip(at.rows.times, found.excess, strict=True)
            if excess > UNEXPLAINED
        ),
        goals,
        DelaySlopes.of(at.rows, base, (found.excess <= UNEXPLAINED).tolist(), at.kp),
        fit_logged_magnitude_laws(recordings),
        None if replayed is None else replayed.scores,
    )
