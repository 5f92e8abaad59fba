"""Position servos in a study: what is unknown of them is identified before the robot.

Study-level: the numerics are in `identification/servo`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.position_servo import PER_JOINT, PositionServo
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import (
    Recorded,
    Samples,
    SignalChain,
    head_of,
    resolve_chain,
)
from asbuilt.experiment.command.torque import drop_slow_rows
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.identify import Fit
from asbuilt.identification.servo.servo_estimate import (
    UNEXPLAINED,
    ServoEstimate,
    estimate_servo,
)
from asbuilt.identification.servo.servo_fits import estimate_servo_delay_errors
from asbuilt.identification.trajectories.simulated_robot import (
    STIFFNESS_SPREAD,
    ServoCoordinates,
)
from asbuilt.identification.uncertainty.delay_errors import DelayErrors, RecordingDelay
from asbuilt.identification.uncertainty.pose_noise import MeanScores
from asbuilt.identification.uncertainty.uncertainty import estimate_recording_variances
from asbuilt.tables import round_with_error
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.workflow.prepare import Prepared, settle_rule
from asbuilt.workflow.study_options import StudyOptions
from asbuilt.workflow.torque_source import TorqueOrigin, with_servo

if TYPE_CHECKING:
    from asbuilt.identification.trajectories.refined_fit import RefinedFit

HORIZON_OF_VERDICT = 0.5
"""Windows [s] by which robots under commands are measured: a stroke of a fast servo, and short
enough that what is left out does not add up."""
EXCEPTION = 1.0 / 3.0
"""Share of the time up to which motion without explanation is an exception, such as contact; more
of it is how the robot moves: own choice."""


def settle_servo(
    model: RobotModel,
    recordings: Sequence[Recorded],
    validation: Sequence[Recorded],
    options: StudyOptions,
    filters: MotionFilters | None = None,
) -> tuple[list[Recorded], list[Recorded], CommandedTorque, StudyOptions]:
    """Return recordings with the torque of their position servo, what it is, and the options.

    `filters` filter their motions, if some serve others too.

    Raises
    ------
    UsageError
        If recordings have different servos, or only some have one.
    """
    servos = [
        None if isinstance(item, Samples) else head_of(item).drive_law
        for item in (*recordings, *validation)
    ]
    if any(
        servo is None
        or servos[0] is None
        or not np.array_equal(getattr(servo, name), getattr(servos[0], name), equal_nan=True)
        for servo in servos
        for name in PER_JOINT
    ):
        raise UsageError(
            "the recordings have torques of different kinds, or of different position servos;"
            " identify from recordings of one servo"
        )
    heads = [head_of(item) for item in recordings if not isinstance(item, Samples)]
    chain = options.chain or SignalChain()
    drive = _select_linear_terms(options.drive) or choose_usual_drive(model, "command")
    found = estimate_servo(
        model,
        heads,
        drive,
        resolve_chain(chain, *heads, filters=filters),
        delay=_read_stated_delay(chain),
        shared=options.same_servos,
        holdout=settle_rule(recordings, options.holdout),
        filters=filters,
    )
    seconds = sum(block.stop - block.start for block in found.unexplained)
    # Most of the motion without explanation is how the robot moves, not an exception.
    if seconds > EXCEPTION * sum(float(np.ptp(item.t)) for item in heads):
        found = replace(found, unexplained=())
    # Numbers of the recordings alone: samples have no servo of their own.
    numbers = np.cumsum([not isinstance(item, Samples) for item in recordings]) - 1
    return (
        [
            item if isinstance(item, Samples) else with_servo(item, found.of_recording(k))
            for k, item in zip(numbers.tolist(), recordings, strict=True)
        ],
        [with_servo(item, found.servo) for item in validation],
        CommandedTorque(found),
        # The servo has taken the delay over: torques of its command are not late.
        replace(options, chain=replace(chain, delay=None)),
    )


@dataclass(frozen=True, eq=False)
class CommandedTorque(TorqueOrigin):
    """Say that a position servo made torques of commands, identified before the robot."""

    servo: ServoEstimate

    @property
    def is_measured(self) -> bool:
        """They are not."""
        return False

    @property
    def expected(self) -> MeanScores | None:
        """Scores that noise of the positions lends the parameters through the law."""
        return self.servo.expected

    @property
    def decisive_horizons(self) -> tuple[float, ...]:
        """Torques that were computed decide nothing: motion does."""
        return (HORIZON_OF_VERDICT,)

    @property
    def of_result(self) -> dict[str, Any]:
        """The servo and its standard errors."""
        return {"servo": self.servo.servo, "servo_errors": self.servo.errors}

    def settle_samples(self, prepared: Prepared, recordings: Sequence[Recorded]) -> Prepared:
        """Return samples without what the servo does not explain, with its delay.

        Rows of a joint count only where its direction of motion is known.
        """
        names = [recording_name(item.source) for item in recordings]
        prepared = self.with_delays(prepared, [*zip(names, prepared.digests, strict=True)])
        if prepared.chain is None:
            return prepared
        drop = partial(self._drop, recordings, prepared.chain.cutoff or np.inf)
        return replace(prepared, training=drop(prepared.training), whole=drop(prepared.whole))

    def _drop(
        self, recordings: Sequence[Recorded], cutoff: float, parts: Sequence[Samples]
    ) -> tuple[Samples, ...]:
        kept = []
        for samples, item in zip(parts, recordings if parts else (), strict=True):
            # Blocks carry the name of their recording.
            windows = [
                (block.start, block.stop)
                for block in self.servo.unexplained
                if block.source == samples.source
            ]
            try:
                left = samples.outside(windows)
            except RecordingError:  # too short for the filters
                continue
            if left.n_filtered and not isinstance(item, Samples):
                kept.append(drop_slow_rows(left, head_of(item), cutoff))
        # Rather unexplained motion than none.
        return tuple(kept) or tuple(parts)

    def with_delays(self, prepared: Prepared, recordings: Sequence[tuple[str, str]]) -> Prepared:
        """Return samples whose recordings have the delay of the servo."""
        late = self.servo.servo.delay
        error = self.servo.errors.delay
        if late is None:
            return replace(prepared, delay=())
        # A stated delay is no estimate.
        estimate, error = (late, error) if error > 0.0 else (np.nan, np.nan)
        delays = (RecordingDelay(*recording, estimate, error, late) for recording in recordings)
        return replace(prepared, delay=tuple(delays))

    @property
    def law(self) -> PositionServo:
        """The servo, which is part of what moves a simulated robot."""
        return self.servo.servo

    @property
    def free(self) -> ServoCoordinates:
        """What of the servo is unknown, so that trajectories are fitted to it."""
        servo = self.servo.servo
        errors = self.servo.errors
        return ServoCoordinates(
            stiffness=any(source != "given" for source in errors.scale),
            delay=errors.delay > 0.0,
            # A torque ahead of its command is no delay: the rate of the error may be the law.
            lead=errors.lead > 0.0 or (self.servo.precedes_command and not any(servo.lead)),
            spread=_estimate_stiffness_spread(self.servo),
        )

    def refined(self, refined: RefinedFit) -> CommandedTorque:
        """Return it with refined gains and delay, and their errors."""
        if refined.law.servo is None:
            return self
        errors = self.servo.errors
        if np.isfinite(refined.law.delay_error):
            errors = replace(errors, delay=refined.law.delay_error)
        if np.isfinite(refined.law.lead_error):
            errors = replace(errors, lead=refined.law.lead_error)
        if np.isfinite(refined.law.stiffness_error):
            gains = tuple(refined.law.stiffness_error * kp for kp in refined.law.servo.kp)
            errors = replace(errors, kp=gains)
        return CommandedTorque(replace(self.servo, servo=refined.law.servo, errors=errors))

    def with_errors(self, fit: Fit) -> Fit:
        """Return a fit whose errors include the servo's delay and what was taken away.

        They are at least those that the scatter between recordings shows.
        """
        late = None
        if self.servo.slopes is not None:
            late = estimate_servo_delay_errors(
                fit.information,
                fit.estimate,
                self.servo.slopes,
                self.servo.servo.delay or 0.0,
                self.servo.errors.delay,
            )
        if self.expected is not None:
            doubt = self.expected.doubt(fit.information, fit.estimate)
            # Errors of the delay, of the replay and between recordings add up in one covariance.
            late = late or DelayErrors(np.zeros_like(doubt), np.zeros(len(doubt)))
            late = replace(late, covariance=late.covariance + doubt)
        beyond = _measure_recording_excess(fit, late)
        if beyond is not None:
            late = late or DelayErrors(np.zeros_like(beyond), np.zeros(len(beyond)))
            late = replace(late, covariance=late.covariance + beyond)
        return fit if late is None else fit.with_errors(delay=late)

    def sentences(self, model: RobotModel) -> tuple[str, ...]:
        """Return what the torque of a command rests on, as a sentence."""
        servo = self.servo.servo
        errors = self.servo.errors
        gains = "; ".join(
            f"{model.joint_names[k]} {_format_estimate(servo.kp[k], errors.kp[k])}"
            for k in model.driven_joints
        )
        late = f"{_format_estimate(1e3 * (servo.delay or 0.0), 1e3 * errors.delay)} ms"
        width = _format_estimate(1e3 * max(servo.deadband, default=0.0), 1e3 * errors.deadband)
        goal = f"; no torque within {width} mrad" if any(servo.deadband) else ""
        if any(servo.falling):
            goal += "; torque limits that fall with the speed"
        if servo.limits_goal:
            limit = _format_estimate(min(servo.goal_acceleration), errors.goal_acceleration)
            goal += f"; goal limited to {limit} rad/s^2"
        return (
            "Torque of a position servo: clip(kp (command(t - delay) - q) - kd qd), the command"
            f" held until the next; kp [N m/rad] {gains}; delay {late}{goal}.",
        )

    def findings(self, model: RobotModel, drive: DriveSet) -> Iterator[Finding]:
        """Yield what is worth knowing of an identified servo."""
        found = self.servo
        errors = found.errors
        yield from _report_gains(model, found)
        yield from _report_goals(found)
        late = _format_estimate(1e3 * (found.servo.delay or 0.0), 1e3 * errors.delay)
        if errors.lead:
            lead = _format_estimate(1e3 * max(found.servo.lead), 1e3 * errors.lead)
            yield Finding(
                "servo_lead",
                "info",
                "The torque preceded the command, which no delay does: the servo was taken to have"
                f" a gain on the rate of its control error, {lead} ms times its stiffness, and a"
                f" delay of {late} ms; viscous friction includes its damping. Positions that are"
                " logged late look alike in smooth motion",
                Cure("state the lead and the torque limit if they are known, or record steps"),
            )
        elif found.precedes_command:
            yield Finding(
                "servo_ahead",
                "info",
                "The torque precedes the command by"
                f" {_format_estimate(-1e3 * (found.servo.delay or 0.0), 1e3 * errors.delay)} ms,"
                " which no"
                " delay does: positions are logged later than commands, or the servo has another"
                " law, such as a gain on the rate of its control error. Torques do not tell which;"
                " under larger steps of the command these differ",
                Cure(
                    "refine by rollouts, which fits such a gain, state the lead and the torque"
                    " limit, or record steps of the command",
                ),
            )
        if errors.deadband:
            width = 1e3 * max(found.servo.deadband)
            error = 1e3 * errors.deadband
            yield Finding(
                "servo_deadband",
                "info",
                f"The servo gives no torque within {_format_estimate(width, error)} mrad of its"
                " goal (mm for"
                " a sliding joint), which time that was not fitted confirms; the fit and"
                " simulations have this deadband",
                Cure("give the deadband if it is known"),
            )
        if found.expected is None:
            why, cure = (
                (
                    "The robot as identified diverges or rests under the logged command",
                    "check the gains of the servo, and record more motion",
                )
                if len(model.driven_joints) == model.n_joints
                else (
                    f"{model.name} has a free base, on which no motion can be replayed for long",
                    "log torques too, or record slow motion with a fine encoder",
                )
            )
            yield Finding(
                "servo_not_replayed",
                "warning",
                f"{why}, so that errors by noise of the positions and by friction at reversals are"
                " not corrected; standard errors are too small",
                Cure(cure),
            )
        if found.unexplained:
            yield _report_unexplained(found)
        yield from _report_currents(model, found)
        # Damping and viscous friction have the same column.
        if any(errors.kd_unknown) and any(term.key == "viscous" for term in drive.terms):
            yield Finding(
                "servo_damping_in_friction",
                "info",
                "The damping of the position servo is unknown: viscous friction includes it, since"
                " only their sum acts",
                Cure("give the damping if it is known"),
            )


def _read_stated_delay(chain: SignalChain) -> float | None:
    """Return the delay of the command that was given; None if it is to be identified."""
    if chain.delay is None:
        return 0.0
    if isinstance(chain.delay, tuple):
        raise UsageError(
            f"the command of a position servo has one delay for all joints, got {len(chain.delay)}"
        )
    return None if chain.delay == "auto" else float(chain.delay)


def _estimate_stiffness_spread(servo: ServoEstimate) -> float:
    """Return the relative standard error of a common stiffness by the fit to torques."""
    free = np.array(servo.errors.scale) != "given"
    unknown = np.array(servo.errors.kp)[free] / np.array(servo.servo.kp)[free]
    # The best known stiffness, as one factor is common to all.
    known = unknown[np.isfinite(unknown) & (unknown > 0.0)]
    return float(np.min(known, initial=STIFFNESS_SPREAD))


def _measure_recording_excess(fit: Fit, late: DelayErrors | None) -> Array | None:
    """Return by how much variances between recordings exceed those so far (p, p); None if not."""
    if fit.uncertainty.basis.kind != "blocks":
        return None
    known = np.diag(fit.uncertainty.covariance)
    if late is not None:
        known = known + np.diag(late.covariance)
    # Only what exceeds the errors known so far is added.
    beyond = np.maximum(estimate_recording_variances(fit.information, fit.estimate) - known, 0.0)
    return np.diag(beyond) if np.any(beyond) else None


def _report_gains(model: RobotModel, found: ServoEstimate) -> Iterator[Finding]:
    """Yield where the stiffness comes from, if it was not given."""
    errors = found.errors
    free = model.driven_joints.start
    names = np.array(model.joint_names)
    unknown = np.array([scale_source != "given" for scale_source in errors.scale])
    relative = np.array(errors.kp) / np.where(unknown, found.servo.kp, 1.0)
    # Relative standard error of a stiffness beyond which only ratios to it are determined.
    lost = unknown & ~(relative < 0.5)
    # Where gains are undetermined their scale is no question.
    if np.any(lost):
        yield Finding(
            "servo_gain_undetermined",
            "warning",
            f"The stiffness of the position servo of {join_names(names[lost].tolist())} is"
            " undetermined: only ratios of parameters to it are determined",
            Cure("give it, or record a motion with more gravity, or a known payload"),
        )
    elif np.any(unknown):
        sources = sorted({scale_source for scale_source in errors.scale if scale_source != "given"})
        one = "one stiffness for all joints" if errors.shared else "a stiffness for each joint"
        yield Finding(
            "servo_gain_from_cad",
            "info",
            f"The stiffness of the position servo was unknown: {one},"
            f" {_format_estimate(found.servo.kp[free], errors.kp[free])} N m/rad for"
            f" {names[unknown][0]}, from the"
            f" {' and '.join(sources)} of CAD. All torques have its relative error",
            Cure(
                "give the stiffness if it is known, or find it from a payload of known mass",
                call="find_gains",
            ),
        )


def _report_currents(model: RobotModel, found: ServoEstimate) -> Iterator[Finding]:
    """Yield what magnitudes logged with the commands show of the servo's damping."""
    listed = [
        (name, law)
        for name, law in zip(model.joint_names, found.currents or (), strict=False)
        if law is not None and law.holds
    ]
    late = found.servo.delay or 0.0
    lags = "; ".join(
        f"{name} {_format_estimate(1e3 * (law.lag - late), 1e3 * law.lag_error)} ms, {law.kind}"
        " current,"
        f" {100.0 * law.explained:.0f} % explained"
        for name, law in listed
    )
    if listed:
        yield Finding(
            "servo_current_explained",
            "info",
            "The log has currents without a sign in addition to the commands, which the"
            f" servo explains with damping / stiffness of {lags}. This much damping is the"
            " servo's, with the voltage that its motor induces; the rest of viscous friction is"
            " the joint's",
            Cure("give the damping as stiffness times this, to tell one from the other"),
        )


def _report_goals(found: ServoEstimate) -> Iterator[Finding]:
    """Yield what recordings show of a limit of the goal's acceleration."""
    everywhere = all(goal_limit is not None for goal_limit in found.goals)
    for goal in filter(None, found.goals):
        first = goal.acts[0]
        seconds = sum(block.stop - block.start for block in goal.acts)
        yield Finding(
            "servo_goal_limited",
            "info",
            "The servo limits the acceleration of its goal to"
            f" {_format_estimate(goal.acceleration, goal.std_error)} rad/s^2 in"
            f" {recording_name(first.source)} (seen in {seconds:.3g} s, first at"
            f" {first.start:.1f} s); the command is passed through this limit"
            + ("" if everywhere else " in this recording, as the others do not show it"),
            Cure("give the limit if it is known; logs validated later need it stated"),
            time=first.start,
        )


def _report_unexplained(found: ServoEstimate) -> Finding:
    blocks = found.unexplained
    seconds = sum(block.stop - block.start for block in blocks)
    listed = [
        f"{recording_name(block.source)} {block.start:.0f} to {block.stop:.0f} s"
        for block in blocks
    ]
    return Finding(
        "unexplained_motion",
        "warning",
        f"{seconds:.3g} s were left out, in which the torque of the command differs from the"
        f" robot's {UNEXPLAINED:g} times as much as usual ({join_names(listed)}): contact, or a"
        " limit of the servo",
        Cure("record without contact and with slower commands, or give the torque limit"),
        time=blocks[0].start,
    )


def _select_linear_terms(drive: DriveSet | str | None) -> DriveSet | None:
    """Return the linear terms of a given drive; None where it is not given or chosen later."""
    if not isinstance(drive, DriveSet):
        return None
    # Nonlinear terms and friction by load have no columns before the robot is known.
    terms = tuple(term for term in drive.terms if not term.nonlinear and not term.needs_load)
    return DriveSet(terms) if terms else None


def _format_estimate(value: float, error: float) -> str:
    if not error:
        return f"{value:.4g}"
    return (
        " +- ".join(round_with_error(value, error))
        if np.isfinite(error)
        else f"{value:.3g} (undetermined)"
    )
