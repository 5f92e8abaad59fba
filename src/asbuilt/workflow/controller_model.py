"""Comparison with the model of a controller that logs external torques."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, RecordingStream, Samples, read_recording
from asbuilt.experiment.logs.recordings import RecordingLike, as_recordings
from asbuilt.experiment.quality.checks import TOO_LITTLE, check_recording
from asbuilt.identification import (
    IdentificationResult,
    TorqueMetrics,
    identify_samples,
    torque_metrics,
)
from asbuilt.tables import Table, format_share, wrap_text
from asbuilt.validation import (
    Drift,
    compare_results,
    recording_name,
    torque_units,
    validate_samples,
)
from asbuilt.validation.comparison.torque_change import tabulate_named_errors
from asbuilt.workflow.prepare import prepare
from asbuilt.workflow.study_options import ControllerOptions
from asbuilt.workflow.study_result import Study

EXTERNAL = "tau_ext"


@dataclass(frozen=True, slots=True, eq=False)
class ControllerComparison:
    """Hold the controller's model, CAD and the robot as built, compared on validation data.

    `identified` are the parameters identified from the torque that the controller predicts, with
    the same drive terms; `difference` compares them with the result's. `controller` is the error of
    the controller's own prediction, `rebuilt` how well the identified parameters reproduce it.
    """

    robot: str
    controller: TorqueMetrics
    cad: TorqueMetrics
    as_built: TorqueMetrics
    rebuilt: TorqueMetrics
    identified: IdentificationResult
    difference: Drift

    def torque_table(self) -> Table:
        """Return the RMS torque errors on the data held out."""
        named = (("CAD", self.cad), ("controller", self.controller), ("as built", self.as_built))
        note = (
            "controller: prediction of the controller's own model, torque less external torque;"
            " parameters identified from it repeat it to"
            f" {format_share(self.rebuilt.relative_error)}."
        )
        title = f"RMS torque error on {recording_name(self.as_built.source)}"
        return tabulate_named_errors(named, torque_units(self.identified.model), title, (note,))

    def verdict(self) -> str:
        """Return the outcome in a sentence."""
        better = int(np.sum(self.as_built.rms < self.controller.rms))
        return (
            "The robot as built predicts torque better than its controller's model at"
            f" {better} of {len(self.as_built.rms)} joints: relative error"
            f" {format_share(self.as_built.relative_error)} against"
            f" {format_share(self.controller.relative_error)} (CAD"
            f" {format_share(self.cad.relative_error)})."
        )

    def as_text(self, full: bool = False) -> str:
        """Return verdict and tables for a terminal; all rows and notes if `full`."""
        tables = (self.torque_table().as_text(full), self.difference.as_text(full))
        return "\n".join([wrap_text(self.verdict()), "", *tables])

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        return {
            "robot": self.robot,
            "verdict": self.verdict(),
            **{
                name: getattr(self, name).as_dict()
                for name in ("controller", "cad", "as_built", "rebuilt")
            },
            "difference": self.difference.as_document(),
        }


def compare_controller(
    result: IdentificationResult | Study,
    recording: RecordingLike,
    *,
    options: ControllerOptions | None = None,
) -> ControllerComparison:
    """Compare a result with the model of the controller that logged a recording.

    That model predicts `tau - tau_ext`. Its parameters are identified from this prediction on what
    `options.holdout` leaves, and all models are validated on what it holds out, which is also new
    to the result if it was identified with the same rule.

    Parameters
    ----------
    result
        The identified robot, or its study.
    recording
        A recording with the external torque `tau_ext` of each joint, as for `identify`.
    options
        How to compare; None: the defaults.

    Returns
    -------
    ControllerComparison
        Torque errors of CAD, controller and robot as built, and their parameters.

    Raises
    ------
    RecordingError
        If the recording has no external torque, or a check finds an error in it.
    """
    options = options or ControllerOptions()
    result = result.result
    logged = _read_whole(result, recording)
    external = logged.extra.get(EXTERNAL)
    if external is None or external.shape != logged.tau.shape:
        present = f"; it has torque and {', '.join(logged.extra)}" if logged.extra else ""
        raise RecordingError(
            f"{logged.source} has no external torque of each joint ({EXTERNAL}){present}; the"
            f" controller's model is tau - {EXTERNAL}"
        )
    if options.checked:
        check_recording(result.model, logged).raise_errors(but=TOO_LITTLE)
    # The controller's prediction is a log of its own, of the same motion.
    predicted = replace(
        logged,
        tau=logged.tau - external,
        source=f"{logged.source}, predicted by the controller",
    )
    # One chain for both, so that they are filtered alike.
    prepared = prepare(
        result.model,
        [logged, predicted],
        chain=options.chain,
        holdout=options.holdout,
        checked=False,
    )
    measured, modelled = prepared.held_out
    identified = identify_samples(result.model, prepared.training[1], base=result.base)
    # Held out by the result too, if it was identified with this rule.
    validation = validate_samples(result, measured)
    return ControllerComparison(
        robot=result.robot,
        controller=torque_metrics(
            validation.measured, modelled.filtered_torque, measured.source, result.joint_names
        ),
        cad=validation.metrics_cad,
        as_built=validation.metrics_as_built,
        rebuilt=validate_samples(identified, modelled).metrics_as_built,
        identified=identified,
        difference=compare_results(
            identified, result, labels=("controller", "as built"), of_models=True
        ),
    )


def _read_whole(result: IdentificationResult, recording: RecordingLike) -> Recording:
    """Return a recording read as a whole, since streams leave out external torques."""
    if isinstance(recording, str | Path):
        return read_recording(recording, model=result.model)
    (item,) = as_recordings(result.model, recording)
    if isinstance(item, RecordingStream):
        return read_recording(item.path, model=result.model, options=item.options)
    if isinstance(item, Samples):
        raise UsageError(
            f"{item.source} is filtered already; give the recording, which has {EXTERNAL}"
        )
    return item
