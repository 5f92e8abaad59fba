"""Joints that stand still while others move.

Their friction then takes any value up to break-away, and no model of it by velocity can tell which.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array

if TYPE_CHECKING:
    from asbuilt.validation.prediction import Validation


@dataclass(frozen=True, slots=True, eq=False)
class StandingErrors:
    """Divide the torque error of each joint, all (n,), into where it stands still and where it
    moves.

    `time` is the share of samples at which it stands, `energy` the share of its squared error that
    falls on them; `standing` and `moving` are RMS errors, `relative_moving` the error while moving
    over the torque while moving. NaN where there are no such samples.
    """

    joint_names: tuple[str, ...]
    time: Array
    energy: Array
    standing: Array
    moving: Array
    relative_moving: Array


def standing_errors(validation: Validation) -> StandingErrors:
    """Divide the errors of a prediction.

    A joint stands where its filtered velocity is exactly zero, which the signal chain makes it.
    """
    still, error = validation.velocity == 0.0, validation.error
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = error**2
        standing, moving = (
            np.where(mask, squares, 0.0).sum(axis=0) / mask.sum(axis=0) for mask in (still, ~still)
        )
        torque = np.where(still, 0.0, validation.measured**2).sum(axis=0) / (~still).sum(axis=0)
        return StandingErrors(
            joint_names=validation.joint_names,
            time=still.mean(axis=0),
            energy=np.where(still, squares, 0.0).sum(axis=0) / squares.sum(axis=0),
            standing=np.sqrt(standing),
            moving=np.sqrt(moving),
            relative_moving=np.sqrt(moving / torque),
        )
