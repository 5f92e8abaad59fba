"""Validation of a result on recordings, and review of a tuned description by them.

Study-level: recordings, options and verdict. The numerics are in the stage `validation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from asbuilt.description import RobotModel, load_robot
from asbuilt.errors import UsageError
from asbuilt.experiment import Samples
from asbuilt.experiment.logs.recordings import (
    Recorded,
    RecordingLike,
    as_recordings,
    read_fitted_recordings,
)
from asbuilt.experiment.signal.samples import RECORDINGS
from asbuilt.findings import Finding
from asbuilt.identification import IdentificationResult, TorqueMetrics
from asbuilt.validation import (
    CadTolerance,
    Rollout,
    Validation,
    Verdict,
    study_verdict,
    validate_description,
    validate_samples,
)
from asbuilt.validation.carried_load import find_carried_load
from asbuilt.validation.review.review import PLAUSIBLE, Review, review_result
from asbuilt.validation.verdicts.model_errors import with_exported
from asbuilt.workflow.prepare import (
    Progress,
    find_unseeing,
    is_trained_on,
    name_held_out,
    prepare,
)
from asbuilt.workflow.study import identify
from asbuilt.workflow.study_options import AUTOMATIC, StudyOptions, ValidationOptions
from asbuilt.workflow.study_result import Study
from asbuilt.workflow.torque_source import drive_as_built, find_asked_torques, require_torque


def validate(
    result: IdentificationResult | Study,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    options: ValidationOptions | None = None,
) -> tuple[Validation, ...]:
    """Predict recordings with an identified model, and with CAD.

    A recording goes through the signal chain that the result was made with. Of a recording that
    the result was identified from, only what was held out is predicted, if anything was. So the
    numbers equal the study's.

    Parameters
    ----------
    result
        The result, or its study.
    recordings
        One recording or several, as for `identify`.
    options
        How to validate; None: the defaults.

    Returns
    -------
    tuple of Validation
        A prediction of each recording, in the order given.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or filters leave nothing of it.
    ResultError
        If joints or geometry do not fit.
    """
    options = options or ValidationOptions()
    result = result.result
    cad = options.cad
    cad = None if cad is None else load_robot(cad)
    found = []
    for recording in as_recordings(result.model, recordings):
        fitted, samples = _prepare_recording(result, recording, options)
        prediction = validate_samples(fitted, samples, cad=cad)
        # A recording that was fitted, in part, carries what the model has.
        load = None if fitted is not result else find_carried_load(result, samples)
        found.append(with_exported(fitted, replace(prediction, load=load), samples))
    return tuple(found)


def decide_validation_verdict(
    result: IdentificationResult,
    recordings: RecordingLike | Sequence[RecordingLike],
    validations: Sequence[Validation],
    rollouts: Sequence[Rollout] = (),
) -> Verdict:
    """Return the verdict on a result by recordings, which earn no use if they are its own.

    `validations` and `rollouts` are of these recordings.
    """
    logged = as_recordings(result.model, recordings)
    seen = result.holdout is None and all(is_trained_on(result, item) for item in logged)
    finding = Finding("nothing_held_out", "warning", "the result was identified from these logs")
    return study_verdict(result, (finding,) if seen else (), validations, rollouts)


def validate_robot(
    robot: RobotModel | str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    options: ValidationOptions | None = None,
) -> tuple[TorqueMetrics, ...]:
    """Predict recordings with a robot as described, drives included.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings, options
        As for `validate`.

    Returns
    -------
    tuple of TorqueMetrics
        The errors on each recording, in the order given.

    Raises
    ------
    UsageError
        If a recording has commands and no gains, whose torque is unknown.
    """
    options = options or ValidationOptions()
    model, (logged,) = read_fitted_recordings(load_robot(robot), (recordings,))
    for recording in logged:
        require_torque(recording)
    return tuple(
        validate_description(
            model,
            prepare(
                model,
                [recording],
                chain=options.chain,
                checked=options.checked,
                estimate_delay=True,
            ).training[0],
        )
        for recording in logged
    )


def _prepare_recording(
    result: IdentificationResult, recording: Recorded, options: ValidationOptions
) -> tuple[IdentificationResult, Samples]:
    """Return what predicts a recording, and its samples; those held out, if it was fitted."""
    recording = drive_as_built(result, recording)
    fitted, rule = (result, None) if options.chain else find_unseeing(result, recording)
    prepared = prepare(
        result.model,
        [recording],
        chain=options.chain or result.chain,
        holdout=rule,
        checked=options.checked,
        estimate_delay=True,
        # A delay that was estimated with the result is not estimated anew, so that numbers agree.
        delays=result.delay if options.chain is None else (),
    )
    samples = (prepared.held_out or prepared.training)[0]
    # The recording was left out as a whole, and its name says so.
    if fitted is not result and rule is None:
        samples = name_held_out(samples, RECORDINGS)
    return fitted, samples


def review(
    robot: RobotModel | str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    tolerance: CadTolerance = PLAUSIBLE,
    options: StudyOptions | None = None,
    progress: Progress | None = None,
) -> Review:
    """Test every number that a description claims with recordings.

    Each number is estimated by weighted least squares without regularisation toward its claim;
    drive parameters are free as well, and masses, centres and inertias are free within
    `tolerance`. It is contradicted if the difference is significant, supported if the standard
    error is at most half of it, else undetermined.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings
        One recording or several, as for `identify`.
    tolerance
        What is plausible for masses, centres and inertias while another number is tested.
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
    >>> from asbuilt.excitation.motions.fourier import random_fourier
    >>> model = load_robot("two-link")
    >>> log = simulate_recording(model, random_fourier(model, rng=1, duration=20.0), rng=1)
    >>> review(model, log).count("contradicted")
    0
    """
    options = options or StudyOptions()
    if options.rollout or options.refine:
        raise UsageError(
            "a review tests numbers with torques; rollouts and refinement go with an identification"
        )
    # A review tests claims: an estimate toward them would confirm them.
    if options.method == "auto":
        options = replace(options, method="wls")
    # Nothing is held out: there is no prediction to judge.
    if options.holdout == AUTOMATIC:
        options = replace(options, holdout=None)
    model, (logged,) = read_fitted_recordings(load_robot(robot), (recordings,))
    study = identify(model, logged, options=options, progress=progress)
    result = study.result
    peaks, motions = find_asked_torques(result, logged, study.training)
    return review_result(
        result,
        peaks=peaks,
        motions=motions,
        tolerance=tolerance,
        findings=study.findings,
    )
