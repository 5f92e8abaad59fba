"""A round before it is learned: the check of its log, and its prediction as an honest test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

import asbuilt
from asbuilt import Recording, RecordingError, RobotModel, Study, ValidationOptions
from asbuilt.apps.run.options import Purpose
from asbuilt.arrays import Array
from asbuilt.excitation import Motion
from asbuilt.findings import Cure, Finding
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


FOLLOWED = 0.4
"""RMS distance of a joint from the motion, in standard deviations of the motion, that a log may
have at the best shift in time; controllers lag by less, other motion is farther off by 1."""
STILL = 0.02
"""Standard deviation [rad or m] below which a joint need not follow: as good as at rest."""
RATE = 50.0
"""Rate at which log and motion are compared [Hz]; no arm moves a radian between two samples."""
SHORTER = 0.9
"""Share of the motion that a log must last."""


def check_log(model: RobotModel, recording: Recording, motion: Motion) -> None:
    """Raise `RecordingError` unless a log is sound, and of the motion that was sent.

    It may begin before the motion and end after it.
    """
    asbuilt.check_recording(model, recording).raise_errors()
    cure = Cure("run the motion of this round to its end, and give its log")
    if recording.duration < SHORTER * motion.duration:
        raise RecordingError(
            f"{recording.source} lasts {recording.duration:.3g} s, the motion that was sent"
            f" {motion.duration:.3g} s",
            cure=cure,
        )
    distance = measure_distance(recording, motion)
    joint = int(np.argmax(distance))
    if distance[joint] > FOLLOWED:
        raise RecordingError(
            f"{recording.source} is not a log of the motion that was sent:"
            f" {model.joint_names[joint]} is off by {100 * distance[joint]:.0f} % of the size of"
            " its motion",
            cure=cure,
            joint=model.joint_names[joint],
        )


def measure_distance(recording: Recording, motion: Motion) -> Array:
    """Return the RMS distance of each joint (n,) from a motion, in standard deviations of it.

    At the shift in time at which all joints together are closest, and without a constant offset,
    as servos sag; zero where a joint rests.
    """
    sent = motion.derivative(motion.sample_times(RATE))
    t = np.arange(recording.t[0], recording.t[-1], 1.0 / RATE)
    logged = np.stack([np.interp(t, recording.t, column) for column in recording.q.T], axis=1)
    sent = sent[: len(logged)]
    size = sent.std(axis=0)
    scale = np.where(size > STILL, 1.0 / np.maximum(size, STILL), 0.0)
    a = logged * scale
    b = (sent - sent.mean(axis=0)) * scale
    sums = _add_windows(a, len(b))
    energy = _add_windows(a**2, len(b))
    cross = [np.correlate(x, y, "valid") for x, y in zip(a.T, b.T, strict=True)]
    # |a - mean a - b|^2 = |a|^2 - |sum a|^2 / N - 2 a.b + |b|^2 of every shift at once.
    squares = energy - sums**2 / len(b) - 2.0 * np.stack(cross, axis=1) + np.sum(b**2, axis=0)
    best = squares[int(np.argmin(squares.sum(axis=1)))]
    return np.asarray(np.sqrt(np.maximum(best, 0.0) / len(b)))


def _add_windows(values: Array, length: int) -> Array:
    """Return the sums of all windows of a length, of each column."""
    running = np.cumsum(np.vstack([np.zeros(values.shape[1]), values]), axis=0)
    return np.asarray(running[length:] - running[:-length])
