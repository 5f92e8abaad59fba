"""The torque that a set of base parameters predicts for a recording, beside the torque that was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import BaseParameters
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import ResultError

if TYPE_CHECKING:
    from asbuilt.experiment.samples import Samples

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Hold measured and predicted torque, both (N, n), at the times `t` (N,) of the filtered and decimated grid."""

    t: Array
    measured: Array
    predicted: Array
    joint_names: tuple[str, ...]
    source: str

    def __post_init__(self) -> None:
        for values in (self.t, self.measured, self.predicted):
            values.setflags(write=False)

    @property
    def error(self) -> Array:
        """Measured minus predicted torque, (N, n)."""
        return self.measured - self.predicted
