"""Validation of a result on recordings, prepared as those that it was identified from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.free_base import refuse_ground
from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.recordings import (
    Recorded,
    RecordingLike,
    as_recordings,
    fitted_recordings,
)
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Finding
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.validation.prediction import Validation, validate_description, validate_samples
from asbuilt.validation.rollout.rollout import Rollout
from asbuilt.validation.verdicts.verdict import Verdict, study_verdict
from asbuilt.validation.verdicts.verdict_error import with_exported
from asbuilt.workflow.options import ValidationOptions
from asbuilt.workflow.prepare import digest, prepare
from asbuilt.workflow.servo import with_servo
from asbuilt.workflow.study import Study


def validate(
    result: IdentificationResult | Study,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    options: ValidationOptions | None = None,
) -> tuple[Validation, ...]:
    """Predict recordings with an identified model, and with CAD beside it.

    A recording goes through the signal chain that the result was made with. Of a recording that
    the result was identified from, only what was held out is predicted, if anything was. So the
    numbers are those of the study.

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
    result = result.result if isinstance(result, Study) else result
    refuse_ground(result.robot, result.model.contacts, options.rollout)
    cad = options.cad
    cad = cad if cad is None or isinstance(cad, RobotModel) else load_robot(cad)
    found = []
    for recording in as_recordings(result.model, recordings):
        samples = _prepared(result, recording, options)
        fitted = as_validated(result, samples)
        found.append(with_exported(fitted, validate_samples(fitted, samples, cad=cad), samples))
    return tuple(found)


def validation_verdict(
    result: IdentificationResult,
    recordings: RecordingLike | Sequence[RecordingLike],
    validations: Sequence[Validation],
    rollouts: Sequence[Rollout] = (),
) -> Verdict:
    """Return the verdict on a result by recordings, which earn no use if they are its own.

    `validations` and `rollouts` are of these recordings.
    """
    logged = as_recordings(result.model, recordings)
    own = result.holdout is None and all(
        not isinstance(each, Samples) and digest(head_of(each)) in result.digests for each in logged
    )
    said = (Finding("nothing_held_out", "warning", "the result was identified from these logs"),)
    return study_verdict(result, said if own else (), validations, rollouts)


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
    """
    options = options or ValidationOptions()
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    refuse_ground(model.name, model.contacts, options.rollout)
    model, (logged,) = fitted_recordings(model, (recordings,))
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


def _prepared(
    result: IdentificationResult, recording: Recorded, options: ValidationOptions
) -> Samples:
    """Return the samples of a recording; those held out, if the result was identified from it."""
    recording = with_servo(recording, result.servo)
    trained = not isinstance(recording, Samples) and digest(head_of(recording)) in result.digests
    prepared = prepare(
        result.model,
        [recording],
        chain=options.chain or result.chain,
        holdout=result.holdout if trained and options.chain is None else None,
        checked=options.checked,
        estimate_delay=True,
        delays=result.delay if options.chain is None else (),
    )
    return (prepared.held_out or prepared.training)[0]


def as_validated(result: IdentificationResult, samples: Samples) -> IdentificationResult:
    """Return the result with the values of its training fit, if the samples were held out of it."""
    held = result.holdout is not None and samples.source.endswith(f", held out {result.holdout}")
    return result.of_training if held else result
