"""Prediction of a round before it is learned: an honest test on another motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

import asbuilt
from asbuilt import Recording, Study, ValidationOptions
from asbuilt.apps.run.options import Purpose
from asbuilt.arrays import Array
from asbuilt.findings import Finding
from asbuilt.validation import Rollout, Validation, Verdict, study_verdict

HORIZON = 0.5
"""Windows [s] in which simulations are tested, as verdicts on logs of commands have them."""
OF_HOLD_OUT = ("nothing_held_out",)
"""Findings on a study without a test, which a round has."""


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """Hold how a model predicted a round that it had not seen.

    Parameters
    ----------
    error
        Found error: of the torque as a share of it, or of the simulated motion as a share of the
        motion in its windows.
    joints
        RMS torque error of each joint (n,) [N m or N].
    validation, rollouts
        The prediction, and the simulations if the model is for a simulator.
    verdict
        Whether to use the model, by this round.
    """

    error: float
    joints: Array
    validation: Validation
    rollouts: tuple[Rollout, ...]
    verdict: Verdict


def predict_round(study: Study, recording: Recording, purpose: Purpose) -> Tested:
    """Return how a model predicts a recording that it was not identified from."""
    # The loop has checked the recording.
    options = ValidationOptions(checked=False)
    (validation,) = asbuilt.validate(study.result, recording, options=options)
    rollouts: tuple[Rollout, ...] = ()
    if is_simulated(study, purpose):
        rollouts = asbuilt.roll_out_result(study.result, recording, [HORIZON], options=options)
    verdict = study_verdict(study.result, without_hold_out(study), (validation,), rollouts)
    error = relate_rollout(rollouts[0]) if rollouts else find_torque_error(validation)
    return Tested(error, validation.metrics_as_built.rms, validation, rollouts, verdict)


def is_simulated(study: Study, purpose: Purpose) -> bool:
    """Return whether errors are of simulated motion: for simulators, and on logs of commands.

    Where commands stand for torques, these are what the law of the servo makes of them.
    """
    return purpose == "simulator" or study.result.servo is not None


def find_torque_error(validation: Validation) -> float:
    """Return the torque error of the robot that exports carry, of the fitted model without one."""
    exported = validation.metrics_exported
    return float((exported or validation.metrics_as_built).relative_error)


def relate_rollout(rollout: Rollout, robot: Literal["as_built", "cad"] = "as_built") -> float:
    """Return the position error of simulations as a share of the motion in their windows.

    `|q_simulated - q| / |q - q_start|` over all samples, joints and windows; infinite where one
    diverges or the robot cannot be simulated.
    """
    error = moved = 0.0
    for motion in rollout.motions:
        q = motion.windows.q
        simulated = getattr(motion, robot)
        if simulated is None:
            return float("inf")
        error += float(np.sum((simulated - q) ** 2))
        moved += float(np.sum((q - q[:, :1]) ** 2))
    ratio = np.sqrt(error / moved) if moved > 0.0 else np.inf
    return float(ratio) if np.isfinite(ratio) else float("inf")


def without_hold_out(study: Study) -> tuple[Finding, ...]:
    """Return the findings of a study that concern its model rather than its lack of a test."""
    return tuple(finding for finding in study.findings if finding.code not in OF_HOLD_OUT)
