"""The robots of an ensemble."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from asbuilt.description.model import RobotModel
from asbuilt.identification.ensembles.ensemble import Ensemble
from asbuilt.writers.models.as_built import (
    keeping_described_drives,
    with_servo,
    with_standard_parameters,
)


def ensemble_model(ensemble: Ensemble, draw: int) -> RobotModel:
    """Return one robot of an ensemble, counted from 0, with its drive terms and servo."""
    result = ensemble.result
    robot = with_standard_parameters(
        result.model, result.base.drive, ensemble.parameters[draw].copy()
    )
    robot = with_servo(robot, ensemble.servo(draw))
    kept, _ = keeping_described_drives(robot, result.model)
    servo = ensemble.servo(draw)
    late = "" if servo is None else f"; delay of the servo {servo.delay!r} s"
    note = f"draw {draw} of {len(ensemble)} from the uncertainty of the identified parameters{late}"
    return replace(kept, notes=(*result.model.notes, note))


def ensemble_models(ensemble: Ensemble) -> Iterator[RobotModel]:
    """Yield all robots of an ensemble."""
    for draw in range(len(ensemble)):
        yield ensemble_model(ensemble, draw)
