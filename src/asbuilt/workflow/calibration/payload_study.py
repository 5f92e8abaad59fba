"""Identification of a payload as a whole: prepare, identify, validate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from asbuilt.experiment.logs.recordings import RecordingLike, as_recordings
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.calibration.added_moments import (
    AddedMoments,
    identify_added_moments,
)
from asbuilt.identification.calibration.payload import (
    Payload,
    identify_payload_samples,
    payload_frame,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.validation.generalisation.payload_order import refuse_swapped
from asbuilt.workflow.options import PayloadOptions
from asbuilt.workflow.prepare import Progress, prepare
from asbuilt.workflow.study import Study


def identify_payload(
    result: IdentificationResult | Study,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    unloaded: RecordingLike | Sequence[RecordingLike] = (),
    validation: RecordingLike | Sequence[RecordingLike] = (),
    options: PayloadOptions | None = None,
    progress: Progress | None = None,
) -> Payload:
    """Identify what the flange carries, and validate it.

    Validation is on what was held out, then on other recordings, or else on the training data. All
    recordings go through one signal chain, chosen from the loaded ones.

    Parameters
    ----------
    result
        The identified arm, or its study.
    recordings
        Recordings under load, one or several, as for `identify`.
    unloaded
        Recordings of the bare arm, which hold its parameters.
    validation
        Recordings under load to validate on.
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    Payload
        Mass, centre of mass and inertia with standard errors, and predictions.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or torques that belong to other joints.
    IdentifiabilityError
        If the recordings do not determine a mass.
    """
    options = options or PayloadOptions()
    result = result.result if isinstance(result, Study) else result
    model = result.model
    prepared = prepare(
        model,
        as_recordings(model, recordings),
        others=(as_recordings(model, unloaded), as_recordings(model, validation)),
        chain=_with_delay(options.chain, result),
        holdout=options.holdout,
        checked=options.checked,
        progress=progress,
    )
    if options.checked:
        refuse_swapped(result, prepared.training, *payload_frame(model, options.frame)[1:])
    bare, others = prepared.others
    return identify_payload_samples(
        result,
        prepared.training,
        unloaded=bare,
        frame=options.frame,
        arm=options.arm,
        validation=(*prepared.held_out, *others)
        or [
            replace(samples, source=f"{samples.source}, the data used")
            for samples in prepared.training
        ],
        gain_uncertainty=options.gain_uncertainty,
    )


def identify_moments(
    result: IdentificationResult | Study,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    unloaded: RecordingLike | Sequence[RecordingLike] = (),
    options: PayloadOptions | None = None,
    progress: Progress | None = None,
) -> AddedMoments:
    """Identify the first moments that a weight on any link adds, with its mass if determined.

    Arguments as for `identify_payload`; `unloaded` recordings of the same motion make the errors
    those of the difference.
    """
    options = options or PayloadOptions()
    result = result.result if isinstance(result, Study) else result
    prepared = prepare(
        result.model,
        as_recordings(result.model, recordings),
        others=(as_recordings(result.model, unloaded),),
        chain=_with_delay(options.chain, result),
        holdout=None,
        checked=options.checked,
        progress=progress,
    )
    (bare,) = prepared.others
    return identify_added_moments(result, prepared.training, unloaded=bare, frame=options.frame)


def _with_delay(chain: SignalChain | None, result: IdentificationResult) -> SignalChain:
    """Return the chain with the delay that the arm was identified with, if it states none."""
    chain = chain or SignalChain()
    known = None if result.chain is None else result.chain.delay
    return replace(chain, delay=known) if chain.delay == "auto" else chain
