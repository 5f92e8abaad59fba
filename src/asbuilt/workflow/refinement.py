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
from asbuilt.identification.trajectories.refined_fit import (
    RefinedFit,
    is_friction_at_rest,
    predict_fall,
    refine_fit,
    thin_windows,
    widen_parameters,
)
from asbuilt.identification.trajectories.simulated_robot import SimulatedRobot
from asbuilt.identification.trajectories.windows import Windows, cut_windows
from asbuilt.validation.rollout.position_errors import RolloutErrors
from asbuilt.validation.rollout.rollout import roll_out
from asbuilt.workflow.rollout import Simulated, SimulatedParts
from asbuilt.workflow.torque_source import TorqueOrigin

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
        Parameters of drives and their law that the trajectories leave where they were.
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
                    Cure("record more motion, or look for contact and torque limits in the log"),
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
    source: TorqueOrigin,
    horizons: Sequence[float],
    report: Callable[[str, float], None],
    *,
    choose: bool = False,
) -> tuple[Fit, TorqueOrigin, Refined, DriveSet]:
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
    Fit, TorqueOrigin, Refined, DriveSet
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
    # Only under commands their law is part of what moves the robot.
    driving = source if kinds == {"command"} else TorqueOrigin()

    def refined(fit: Fit, driving: TorqueOrigin, begin: Array | None = None) -> RefinedFit:
        return refine_fit(
            fit,
            windows,
            driving.law,
            free=driving.free,
            begin=begin,
            progress=lambda fraction: report("refine", fraction),
        )

    best = refined(fit, driving)
    iterations = best.refinement.iterations
    term = available_terms()["stribeck"]
    term = term.with_nonlinear(
        {parameter.name: parameter.default for parameter in term.nonlinear if parameter.fitted}
    )
    if choose and _calls_for(best, term):
        wider = drive.with_term(term)
        n = fit.model.n_joints
        begin = widen_parameters(best.refinement.point.chi, drive, wider, n)
        other = refined(fitted(wider), driving.refined(best), begin)
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
    return best.fit, driving.refined(best) if driving is source else source, tried, drive


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
        windows,
        [one.driven_by(cut.signal) for cut in windows],
        [other.driven_by(cut.signal) for cut in windows],
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
