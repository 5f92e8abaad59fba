"""Torque errors of joints at rest and in motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array

if TYPE_CHECKING:
    from asbuilt.validation.prediction import Validation


@dataclass(frozen=True, slots=True, eq=False)
class RestingErrors:
    """Divide the torque error of each joint, all (n,), into rest and motion.

    `time` is the share of samples at rest, `energy` the share of the squared error that falls on
    them; `resting` and `moving` are RMS errors, `relative_moving` the error in motion over the
    torque in motion. NaN if there are no such samples.
    """

    joint_names: tuple[str, ...]
    time: Array
    energy: Array
    resting: Array
    moving: Array
    relative_moving: Array


def divide_resting_errors(validation: Validation) -> RestingErrors:
    """Divide the errors of a prediction.

    At rest a joint is held by static friction, which may take any value up to break-away. A joint
    is at rest if its filtered velocity is exactly zero, which the signal chain makes it.
    """
    still, error = validation.velocity == 0.0, validation.error
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = error**2
        resting, moving = (
            np.where(mask, squares, 0.0).sum(axis=0) / mask.sum(axis=0) for mask in (still, ~still)
        )
        torque = np.where(still, 0.0, validation.measured**2).sum(axis=0) / (~still).sum(axis=0)
        return RestingErrors(
            joint_names=validation.joint_names,
            time=still.mean(axis=0),
            energy=np.where(still, squares, 0.0).sum(axis=0) / squares.sum(axis=0),
            resting=np.sqrt(resting),
            moving=np.sqrt(moving),
            relative_moving=np.sqrt(moving / torque),
        )
