"""Review of a tuned robot description by recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.errors import UsageError
from asbuilt.experiment.command.servo_torque import driven_by_command
from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.recordings import Recorded, RecordingLike, fitted_recordings
from asbuilt.experiment.signal.samples import Samples
from asbuilt.validation.comparison.cad_tolerance import CadTolerance
from asbuilt.validation.review.review import PLAUSIBLE, Review, review_result
from asbuilt.workflow.options import AUTOMATIC, StudyOptions
from asbuilt.workflow.prepare import Progress
from asbuilt.workflow.study import identify


def review(
    robot: RobotModel | str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    tolerance: CadTolerance = PLAUSIBLE,
    options: StudyOptions | None = None,
    progress: Progress | None = None,
) -> Review:
    """Judge every number that a description claims by recordings.

    Each number is estimated by weighted least squares with nothing that pulls it to its claim;
    drive parameters beside it are free, and masses, centres and inertias are free within
    `tolerance`. It is contradicted if the difference is significant, supported if the standard
    error is at most half of it, else undetermined.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings
        One recording or several, as for `identify`.
    tolerance
        What is plausible for masses, centres and inertias while another number is judged.
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    Review
        A verdict on every number, contradicted ones first.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or filters leave nothing of it.
    IdentifiabilityError
        If the recordings are too short.
    UsageError
        If no recording is given or an option has no meaning for a review.

    Examples
    --------
    >>> from asbuilt import load_robot, review, simulate_recording
    >>> from asbuilt.excitation.motions.random_motion import random_fourier
    >>> model = load_robot("two-link")
    >>> log = simulate_recording(model, random_fourier(model, rng=1, duration=20.0), rng=1)
    >>> review(model, log).count("contradicted")
    0
    """
    options = options or StudyOptions()
    if options.rollout or options.refine:
        raise UsageError(
            "a review judges numbers by torques; rollouts and refinement go with an identification"
        )
    if options.method == "auto":
        options = replace(options, method="wls")
    if options.holdout == AUTOMATIC:
        options = replace(options, holdout=None)
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    model, (logged,) = fitted_recordings(model, (recordings,))
    study = identify(model, logged, options=options, progress=progress)
    result = study.result
    unlimited = result.servo is not None and not np.any(np.isfinite(result.servo.torque_limit))
    return review_result(
        result,
        peaks=None if result.servo is None else _peaks(logged, result.servo),
        motions=study.training if unlimited else (),
        tolerance=tolerance,
        findings=study.findings,
    )


def _peaks(recordings: Sequence[Recorded], servo: PositionServo) -> Array:
    """Return the largest torque (n,) that the servo of each joint was asked for."""
    free = replace(servo, torque_limit=())
    heads = [head_of(item) for item in recordings if not isinstance(item, Samples)]
    asked = [driven_by_command(head, free).tau for head in heads if head.command is not None]
    return np.asarray(np.max([np.abs(tau).max(axis=0) for tau in asked], axis=0))
