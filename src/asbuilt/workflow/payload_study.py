"""From recordings under load to the payload: filter, hold out, identify, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from numpy.typing import ArrayLike

from asbuilt.errors import UsageError
from asbuilt.experiment.logs.long_recordings import RecordingStream, head_of, prepare_logged
from asbuilt.experiment.quality.checks import refuse_spoilt
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.hold_out import hold_out
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.calibration.payload import Arm, Payload, identify_payload, payload_frame
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.validation.generalisation.payload_order import refuse_exchanged


def run_payload_study(
    result: IdentificationResult,
    loaded: Sequence[Recording | RecordingStream],
    unloaded: Sequence[Recording | RecordingStream] = (),
    validation: Sequence[Recording | RecordingStream] = (),
    *,
    chain: SignalChain | None = None,
    holdout: str | None = None,
    frame: str | None = None,
    arm: Arm = "refined",
    gain_uncertainty: ArrayLike | None = None,
    checked: bool = True,
) -> Payload:
    """Identify what the flange carries and judge it on what was held out of the loaded recordings,
    on other ones, or else on the data used.

    All recordings go through one signal chain, whose open choices are made for the loaded ones.
    `gain_uncertainty` and errors as of `identify_payload`. Raises RecordingError where a check
    finds that a recording is spoilt or its torques do not belong to their joints, unless `checked`
    is False.
    """
    if not loaded:
        raise UsageError(f"no recording under load is given for {result.robot}")
    if checked:
        refuse_spoilt(result.model, (*loaded, *unloaded, *validation))
    resolved = (chain or SignalChain()).resolved(*(head_of(recording) for recording in loaded))
    learning = [prepare_logged(recording, resolved) for recording in loaded]
    if checked:
        refuse_exchanged(result, learning, *payload_frame(result.model, frame)[1:])
    judging = [prepare_logged(recording, resolved) for recording in validation]
    if holdout is not None:
        parts = [hold_out(samples, holdout) for samples in learning]
        learning = [train for train, _ in parts]
        judging = [
            replace(held, source=f"{held.source}, held out {holdout}") for _, held in parts
        ] + judging
    judging = judging or [
        replace(samples, source=f"{samples.source}, the data used") for samples in learning
    ]
    bare = [prepare_logged(recording, resolved) for recording in unloaded]
    return identify_payload(
        result,
        learning,
        unloaded=bare,
        frame=frame,
        arm=arm,
        validation=judging,
        gain_uncertainty=gain_uncertainty,
    )
