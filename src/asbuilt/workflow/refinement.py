"""Refinement of a study by simulated trajectories of its training data.

Study-level: the numerics are in `identification/trajectories`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics import DriveSet, DriveTerm, available_terms
from asbuilt.errors import RecordingError, UsageError
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.effects.trials import RULES as EFFECT_RULES
from asbuilt.identification.identify import Fit
from asbuilt.identification.servo.servo_estimate import ServoEstimate
from asbuilt.identification.trajectories.refined_fit import (
    RefinedFit,
    is_friction_at_rest,
    predict_fall,
    refine_fit,
    thin_windows,
    widen_parameters,
)
from asbuilt.identification.trajectories.simulated_robot import (
    STIFFNESS_SPREAD,
    ServoCoordinates,
    SimulatedRobot,
)
from asbuilt.identification.trajectories.windows import Windows, cut_windows
from asbuilt.validation.rollout.position_errors import RolloutErrors
from asbuilt.validation.rollout.rollout import roll_out
from asbuilt.workflow.rollout import Simulated, SimulatedParts, drop_unused_servo
from asbuilt.workflow.torque_source import MeasuredTorque

# Hold lengths of windows, and when a refinement is worth its parameters.

REFINEMENT_USUAL = 0.5  # Length of the windows [s] unless rollouts are asked for
# Longest windows [s]: errors of the state at the start and unmodelled effects add up in them
REFINEMENT_LONGEST = 1.0
REFINEMENT_NO_EFFECT = 0.5  # Mean fall of the logarithmic likelihood by a parameter without effect
# Fall by a parameter from which a fit predicts better (Akaike, IEEE Trans. Automatic Control 19,
# 1974; the variance of scores is counted, Burnham and Anderson, Model Selection, 2002, section
# 2.5).
REFINEMENT_WORTH = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Hold how a refinement went.

    Attributes
    ----------
    horizon
        Length of the windows [s].
    iterations, seconds
        Steps of the search, and the time they took.
    before, after
        Errors of rollouts of this length on data not fitted, or on the training data if nothing
        was held out, of windows of a minute in all; None if there is none of this length.
    kept
        Whether the result is the robot after, which its rollouts predict no worse.
    undetermined
        Drive and servo parameters that the trajectories leave where they were.
    start
        The robot before.
    """

    horizon: float
    iterations: int
    seconds: float
    undetermined: tuple[str, ...]
    start: SimulatedRobot
    before: RolloutErrors | None = None
    after: RolloutErrors | None = None
    kept: bool = True

    def as_dict(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "horizon": self.horizon,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "before": None if self.before is None else self.before.as_dict(),
            "after": None if self.after is None else self.after.as_dict(),
            "kept": self.kept,
            "undetermined": list(self.undetermined),
        }

    def findings(self) -> tuple[Finding, ...]:
        """Return what trajectories leave undetermined, or why they are not followed."""
        if not self.kept:
            before, after = (
                "a simulation that cannot start" if simulated is None else simulated.text_until
                for simulated in (self.before, self.after)
            )
            return (
                Finding(
                    "refinement_rejected",
                    "warning",
                    f"Refined by trajectories, the robot is simulated worse on windows of"
                    f" {self.horizon:g} s ({after}, before {before}): the result is the fit to"
                    " torques",
                    Cure(
                        "record more motion, or look for contact and limits of the servo in the log"
                    ),
                ),
            )
        finding = Finding(
            "refinement_undetermined",
            "info",
            "Trajectories hardly determine"
            f" {join_names(list(self.undetermined), 8)}; these stay near the fit to torques",
            Cure("record a motion that moves these joints faster, slower or with reversals"),
        )
        return (finding,) if self.undetermined else ()


def refine_study(
    fitted: Callable[[DriveSet], Fit],
    drive: DriveSet,
    parts: SimulatedParts,
    source: MeasuredTorque,
    horizons: Sequence[float],
    report: Callable[[str, float], None],
    *,
    choose: bool = False,
) -> tuple[Fit, MeasuredTorque, Refined, DriveSet]:
    """Continue a fit by trajectories of training data.

    Parameters
    ----------
    fitted
        Returns the fit to torques with these drive terms.
    drive
        The drive terms.
    parts
        What is simulated, and what the refinement must not predict worse than the fit to torques:
        what was not fitted, or if nothing was held out the training data.
    source
        Where the torques come from.
    horizons
        Lengths of rollouts that are asked for [s].
    report
        Called with the name of a step and the fraction done.
    choose
        Whether Stribeck friction is added if by Akaike's criterion the trajectories call for it and
        motion that was not fitted is simulated better with it, as of every effect: torques hardly
        show it, since joints at rest, and slow ones under a filter, do not count.

    Returns
    -------
    Fit, MeasuredTorque, Refined, DriveSet
        The refined fit, its source of torques, how the refinement went, and its drive terms.

    Raises
    ------
    UsageError
        If motors of the robot are coupled, or torques and commands are mixed.
    RecordingError
        If no window fits into the training data.
    """
    # Torques first: trajectories start from a robot that is nearly right.
    fit = fitted(drive)
    if np.any(fit.model.motor_shares):
        raise UsageError(
            f"{fit.model.name} has motors that turn with several joints; trajectories of such"
            " robots are simulated, but not fitted"
        )
    kinds = {signal.kind for _, _, signal in parts.trained}
    if len(kinds) != 1:
        raise UsageError("trajectories under torques and under commands cannot be fitted together")
    began = time.perf_counter()
    given = drive
    horizon = min(max(horizons, default=REFINEMENT_USUAL), REFINEMENT_LONGEST)
    windows = _cut_windows(parts.trained, horizon)
    # Only under commands the servo is part of what moves the robot.
    driven = source.servo if kinds == {"command"} else None

    def refined(fit: Fit, servo: ServoEstimate | None, begin: Array | None = None) -> RefinedFit:
        return refine_fit(
            fit,
            windows,
            None if servo is None else servo.servo,
            of_servo=_make_servo_coordinates(servo),
            begin=begin,
            progress=lambda fraction: report("refine", fraction),
        )

    best = refined(fit, driven)
    iterations = best.refinement.iterations
    term = available_terms()["stribeck"]
    term = term.with_nonlinear(
        {parameter.name: parameter.default for parameter in term.nonlinear if parameter.fitted}
    )
    if choose and _calls_for(best, term):
        wider = drive.with_term(term)
        n = fit.model.n_joints
        begin = widen_parameters(best.refinement.point.chi, drive, wider, n)
        before = None if driven is None else _update_servo(driven, best)
        other = refined(fitted(wider), before, begin)
        iterations += other.refinement.iterations
        # Akaike, a parameter a joint; and motion that was not fitted must agree.
        gained = _measure_gain(best, other) > REFINEMENT_WORTH * n
        if gained and _is_better(best, other, wider, parts.held_out or parts.trained, horizon):
            best = replace(other, start=best.start)
            drive = wider
    seconds = time.perf_counter() - began
    tried = Refined(horizon, iterations, seconds, best.undetermined, best.start)
    tried = _validate_refinement(tried, best.robot, parts.held_out or parts.trained)
    # A robot that is simulated worse than before is not the result.
    if not tried.kept:
        return fit, source, tried, given
    if driven is not None:
        source = source.with_servo(_update_servo(driven, best))
    return best.fit, source, tried, drive


def _calls_for(found: RefinedFit, term: DriveTerm) -> bool:
    """Return whether the trajectories promise to be explained better with a term."""
    objective = found.objective
    keys = objective.trajectories.base.drive.keys
    n = objective.trajectories.model.n_joints
    # Stribeck friction replaces Coulomb's: without it there is nothing to replace.
    if "coulomb" not in keys or term.key in keys:
        return False
    return predict_fall(objective, found.refinement, term) > REFINEMENT_NO_EFFECT * n


def _measure_gain(found: RefinedFit, other: RefinedFit) -> float:
    """Return by how much the cost of the windows is lower in another fit, weights as in the first.

    Infinite if only the first diverges.
    """
    one, two = (
        sum(
            float(np.sum(costs))
            for costs in of.objective.window_costs(
                of.refinement.point, of.refinement.motions, found.refinement.weights
            )
        )
        for of in (found, other)
    )
    # The wider fit diverges: no gain, however the first one went.
    return one - two if np.isfinite(two) else -np.inf


def _is_better(
    found: RefinedFit,
    other: RefinedFit,
    wider: DriveSet,
    parts: Sequence[Simulated],
    horizon: float,
) -> bool:
    """Return whether a fit with more terms has possible friction and simulates parts better.

    Errors must fall by what an effect must be worth: friction whose sign changes softly is
    explained by some more at rest too, in fitted windows alone.
    """
    if not is_friction_at_rest(wider, other.robot.values, other.value_errors):
        return False
    try:
        before, after = _measure_rollout_errors(found.robot, other.robot, parts, horizon)
    except RecordingError:
        return False
    if before is None or after is None or after.diverged > before.diverged:
        return False
    return after.rms_all_until**2 < (1.0 - EFFECT_RULES.worth) * before.rms_all_until**2


def _make_servo_coordinates(servo: ServoEstimate | None) -> ServoCoordinates:
    """Return what of a servo is unknown, so that trajectories are fitted to it."""
    if servo is None:
        return ServoCoordinates()
    return ServoCoordinates(
        stiffness=any(x != "given" for x in servo.errors.scale),
        delay=servo.errors.delay > 0.0,
        # A torque ahead of its command is no delay: the rate of the error may be the law.
        lead=servo.errors.lead > 0.0 or (servo.precedes_command and not any(servo.servo.lead)),
        spread=_estimate_stiffness_spread(servo),
    )


def _estimate_stiffness_spread(servo: ServoEstimate) -> float:
    """Return the relative standard error of a common stiffness by the fit to torques."""
    free = np.array(servo.errors.scale) != "given"
    unknown = np.array(servo.errors.kp)[free] / np.array(servo.servo.kp)[free]
    # The best known stiffness, as one factor is common to all.
    known = unknown[np.isfinite(unknown) & (unknown > 0.0)]
    return float(np.min(known, initial=STIFFNESS_SPREAD))


def _validate_refinement(
    refined: Refined, robot: SimulatedRobot, parts: Sequence[Simulated]
) -> Refined:
    """Return the refinement with the errors of rollouts before and after it."""
    try:
        before, after = _measure_rollout_errors(refined.start, robot, parts, refined.horizon)
    except RecordingError:
        return refined
    if before is None or after is None:
        # Where only one robot can start, it is the better one.
        return replace(refined, before=before, after=after, kept=after is not None)
    # Windows that diverge count before errors, which they have none of.
    kept = (after.diverged, after.rms_all_until) <= (before.diverged, before.rms_all_until)
    return replace(refined, before=before, after=after, kept=kept)


def _measure_rollout_errors(
    one: SimulatedRobot, other: SimulatedRobot, parts: Sequence[Simulated], horizon: float
) -> tuple[RolloutErrors | None, RolloutErrors | None]:
    """Return the errors of two robots, None where one cannot start; raises as `_cut_windows`."""
    windows = thin_windows(_cut_windows(parts, horizon))
    found = roll_out(
        other.model,
        # A servo that is not used would act on the torque as well.
        windows,
        [drop_unused_servo(one, cut.signal) for cut in windows],
        [drop_unused_servo(other, cut.signal) for cut in windows],
    )
    return found.cad, found.as_built


def _cut_windows(parts: Sequence[Simulated], horizon: float) -> list[Windows]:
    """Cut what is long enough; raises RecordingError if nothing is."""
    found = list[Windows]()
    problem = None
    for recording, samples, signal in parts:
        try:
            found.append(cut_windows(recording, samples, horizon, signal))
        except RecordingError as short:
            problem = short
    if not found and problem is not None:
        raise problem
    return found


def _update_servo(servo: ServoEstimate, refined: RefinedFit) -> ServoEstimate:
    """Return the estimate of a servo with refined gains and delay, and their errors."""
    if refined.servo is None:
        return servo
    errors = servo.errors
    if np.isfinite(refined.delay_error):
        errors = replace(errors, delay=refined.delay_error)
    if np.isfinite(refined.lead_error):
        errors = replace(errors, lead=refined.lead_error)
    if np.isfinite(refined.stiffness_error):
        errors = replace(errors, kp=tuple(refined.stiffness_error * kp for kp in refined.servo.kp))
    return replace(servo, servo=refined.servo, errors=errors)
