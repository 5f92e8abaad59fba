"""Data that estimators use."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

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

    Parameters
    ----------
    model
        The robot as designed.
    information
        Square-root information of the samples.
    samples
        The samples themselves, iterable more than once; None if only the information is at hand.
    prior
        Base parameters by design (p,), NaN where the description has no value.
    undetermined
        Whether directions without excitation are resolved toward `prior`, or refused.
    block_seconds
        Length of a time block [s].
    every
        Use the rows of every n-th time block alone.
    loading
        Robot whose rigid-body torque loads load-dependent friction; `model` if None.
    less
        Parameters of each joint (p_k,) whose torque was taken from the torque in `information`, and
        is taken from the torque of the rows; empty: none.
    """

    model: RobotModel
    information: SquareRootInformation
    samples: Iterable[Samples] | None = None
    prior: Array | None = None
    undetermined: Undetermined = "toward_prior"
    block_seconds: float | None = None
    every: int = 1
    loading: RobotModel | None = None
    less: tuple[Array, ...] = ()

    @property
    def base(self) -> BaseParameters:
        """The base parameters."""
        return self.information.base

    @property
    def prior_values(self) -> Array:
        """The prior with 0 where the description has no value, shape (p,)."""
        prior = np.zeros(self.base.n_base) if self.prior is None else self.prior
        return np.nan_to_num(prior, nan=0.0)

    @cached_property
    def rows(self) -> Rows:
        """The rows behind the information, by time block."""
        return self.rows_of(self.batches)

    def rows_of(self, samples: Iterable[Samples]) -> Rows:
        """Return the rows of other samples with the same time blocks."""
        return Rows(
            self.loading or self.model,
            self.base,
            samples,
            self.block_seconds,
            self.every,
            self.less,
        )

    @property
    def batches(self) -> Iterable[Samples]:
        """The samples; raises `UsageError` if only the information is at hand."""
        if self.samples is None:
            raise UsageError(
                "this estimator needs the samples, and only their information is at hand; use an"
                " estimator that needs the information alone, such as wls"
            )
        return self.samples
