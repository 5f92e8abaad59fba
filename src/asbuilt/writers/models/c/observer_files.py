"""Files of a robot's observer in C."""

from __future__ import annotations

import os
from pathlib import Path

from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import carrying
from asbuilt.monitoring.model_error import ModelError
from asbuilt.monitoring.observer import BANDWIDTH
from asbuilt.monitoring.thresholds import Thresholds
from asbuilt.writers.models.c.c_code import write_c
from asbuilt.writers.models.c.c_observer import observer_code


def write_observer(
    path: str | os.PathLike[str],
    result: IdentificationResult,
    *,
    thresholds: Thresholds | None = None,
    bandwidth: float = BANDWIDTH,
) -> tuple[Path, Path]:
    """Write `NAME.c` and `NAME.h` with the dynamics of the robot as built and its observer.

    The parameters are exactly the identified ones, also where no physically consistent links have
    them. Returns both paths.

    Raises
    ------
    UsageError
        If the file is not named `.c`, or thresholds belong to other joints.
    """
    if thresholds is not None:
        thresholds.check_joints(result.model.joint_names)
    torque = result.torque_model
    model = carrying(result.model, result.base, result.estimates)
    return write_c(
        path,
        model,
        drive=torque.drive,
        drive_values=torque.values,
        observer=lambda name: observer_code(
            name,
            model.n_joints,
            bandwidth=bandwidth,
            thresholds=thresholds,
            factor=ModelError.of(result).factor,
        ),
    )
