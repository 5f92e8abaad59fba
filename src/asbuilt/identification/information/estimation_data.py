"""What estimators estimate from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import UsageError
from asbuilt.identification.information.rows import Rows
from asbuilt.identification.information.square_root_information import SquareRootInformation

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

Undetermined = Literal["toward_prior", "refuse"]


@dataclass(frozen=True, eq=False)
class EstimationData:
    """Hold all that an estimator may use.

    The robot, the square-root information, the samples behind it and the values by design.

    `samples` can be gone through again and again; None where only the information is at hand.
    `prior` (p,) are the base parameters by design, NaN where the description is silent; directions
    that nothing excites are resolved toward it, or refused (`undetermined`). `every` n gives the rows
    of each n-th time block alone. `loading` is the robot whose rigid-body torque loads friction
    that depends on it, where that is not `model`.
    """

    model: RobotModel
    information: SquareRootInformation
    samples: Iterable[Samples] | None = None
    prior: Array | None = None
    undetermined: Undetermined = "toward_prior"
    block_seconds: float | None = None
    every: int = 1
    loading: RobotModel | None = None

    @property
    def base(self) -> BaseParameters:
        """The base parameters."""
        return self.information.base

    @cached_property
    def rows(self) -> Rows:
        """The rows behind the information, time block by time block.

        Raises `UsageError` where the samples are not at hand.
        """
        return self.rows_of(self.batches)

    def rows_of(self, samples: Iterable[Samples]) -> Rows:
        """Return the rows of other samples with the same time blocks."""
        return Rows(self.loading or self.model, self.base, samples, self.block_seconds, self.every)

    @property
    def batches(self) -> Iterable[Samples]:
        """The samples; raises `UsageError` where they are not at hand."""
        if self.samples is None:
            raise UsageError(
                "this estimator goes over the samples again; call identify with them, or use wls,"
                " which needs the information alone"
            )
        return self.samples
