"""The maker's own model, as far as a controller gives it away.

Measured torque less the external torque it makes of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.hold_out import hold_out
from asbuilt.experiment.signal.signal_chain import SignalChain, prepare_samples
from asbuilt.identification.identify import identify
from asbuilt.identification.result.metrics import TorqueMetrics, torque_metrics
from asbuilt.tables import Cell, Column, Shown, Table, share, significant
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.comparison.drift import Drift, compare_results
from asbuilt.validation.prediction import torque_units, validate

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult

EXTERNAL = "tau_ext"


@dataclass(frozen=True, slots=True, eq=False)
class ControllerComparison:
    """Hold the controller's model beside CAD and the robot as built, on data held out, and its
    parameters beside those as built.

    `identified` are the parameters identified from the torque that the controller predicts, with
    the same drive terms; `difference` compares them with the result's. `controller` is the error of
    the controller's own prediction, `rebuilt` how well the identified parameters repeat it.
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
        units = torque_units(self.identified.model)
        heads = [
            Column("model"),
            *(
                Column(name, unit, "decimal", width=16)
                for name, unit in zip(self.as_built.joint_names, units, strict=True)
            ),
        ]
        heads.append(Column("relative error", align="decimal"))
        rows: list[tuple[Cell, ...]] = []
        for what, metrics in (
            ("CAD", self.cad),
            ("controller", self.controller),
            ("as built", self.as_built),
        ):
            errors = [Shown(float(error), significant(float(error))) for error in metrics.rms]
            rows.append(
                (what, *errors, Shown(metrics.relative_error, share(metrics.relative_error)))
            )
        note = (
            "controller: what its external torque says that its own model predicts; parameters"
            f" identified from that prediction repeat it to {share(self.rebuilt.relative_error)} of"
            " its torque."
        )
        return Table(
            tuple(heads),
            tuple(rows),
            title=f"RMS torque error on {recording_name(self.as_built.source)}",
            notes=(note,),
        )

    def verdict(self) -> str:
        """Return the outcome in a sentence."""
        better = int(np.sum(self.as_built.rms < self.controller.rms))
        return (
            f"As built the robot is predicted better than by its controller's model at {better} of"
            f" {len(self.as_built.rms)} joints: relative error"
            f" {share(self.as_built.relative_error)} against"
            f" {share(self.controller.relative_error)} (CAD {share(self.cad.relative_error)})."
        )

    def as_text(self) -> str:
        """Return verdict and tables for a terminal."""
        return "\n".join(
            [self.verdict(), "", self.torque_table().as_text(), self.difference.as_text()]
        )

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        metrics = {
            name: getattr(self, name).as_dict()
            for name in ("controller", "cad", "as_built", "rebuilt")
        }
        return {
            "robot": self.robot,
            "verdict": self.verdict(),
            **metrics,
            "difference": self.difference.as_document(),
        }


def compare_with_controller(
    result: IdentificationResult,
    recording: Recording,
    *,
    holdout: str = "blocks:5s:3",
    chain: SignalChain | None = None,
) -> ControllerComparison:
    """Compare a result with the model of the controller that logged `recording`.

    `tau - tau_ext` is what that model predicts.

    Parameters are identified from the controller's prediction on what `holdout` leaves and all
    models are judged on what it holds out, which is also new to the result where it was identified
    with the same rule. Raises RecordingError where no external torque was logged.
    """
    external = recording.extra.get(EXTERNAL)
    if external is None or external.shape != recording.tau.shape:
        logged = f"; beside torque it has {', '.join(recording.extra)}" if recording.extra else ""
        raise RecordingError(
            f"{recording.source} has no external torque of each joint ({EXTERNAL}){logged}; the"
            f" controller's model shows in tau - {EXTERNAL}"
        )
    settled = (chain or SignalChain()).resolved(recording)
    predicted = replace(
        recording,
        tau=recording.tau - external,
        source=f"{recording.source}, predicted by the controller",
    )
    _, measured = hold_out(prepare_samples(recording, settled), holdout)
    learning, modelled = hold_out(prepare_samples(predicted, settled), holdout)
    identified = identify(result.model, learning, base=result.base)
    validation = validate(result, measured)
    shown = modelled.filtered_torque
    return ControllerComparison(
        robot=result.robot,
        controller=torque_metrics(validation.measured, shown, measured.source, result.joint_names),
        cad=validation.metrics_cad,
        as_built=validation.metrics_as_built,
        rebuilt=validate(identified, modelled).metrics_as_built,
        identified=identified,
        difference=compare_results(
            identified, result, labels=("controller", "as built"), of_models=True
        ),
    )
