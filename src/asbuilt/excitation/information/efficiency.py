"""How much of the attainable information a recorded motion carries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.excitation.information.information import Information, mean_information
from asbuilt.excitation.information.information_bound import InformationBound, information_bound
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import read_only

MOST_SAMPLES = 20000
"""Samples of a recording that are looked at; of longer ones every second, third, ..."""
ROUNDS = 3
"""Rounds in which the bound is tightened.

A recording is judged to a few per cent, a design more sharply.
"""


class JointStates(Protocol):
    """Anything with joint states `q`, `qd`, `qdd` (N, n): samples of a recording, a sampled motion."""

    @property
    def q(self) -> Array:
        """Positions."""

    @property
    def qd(self) -> Array:
        """Velocities."""

    @property
    def qdd(self) -> Array:
        """Accelerations."""


@dataclass(frozen=True, eq=False)
class InformationEfficiency:
    """Compare a motion with the best distribution over the states that the limits admit, sample for
    sample.

    `d_efficiency` is `exp((log det M - log det M_bound) / p)`, 0 where the motion leaves a
    parameter untold. `by_parameter` (p,) is the variance that the best distribution gives each base
    parameter over the variance that the motion gives it; it may exceed 1 for some.
    """

    base: BaseParameters
    d_efficiency: float
    by_parameter: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_parameter", read_only(self.by_parameter))

    @property
    def owners(self) -> NDArray[np.intp]:
        """The joint, counted from 0, to whose link or drive each base parameter belongs (p,)."""
        columns, per = self.base.columns, self.base.drive.columns_per_joint
        return np.where(
            columns < 10 * self._n_joints,
            columns // 10,
            (columns - 10 * self._n_joints) // max(per, 1),
        )

    @property
    def worst(self) -> tuple[int | None, ...]:
        """Which base parameter of each joint is told worst, None for a joint without any."""
        own = [np.flatnonzero(self.owners == k) for k in range(self._n_joints)]
        return tuple(
            int(each[np.argmin(self.by_parameter[each])]) if each.size else None for each in own
        )

    @property
    def by_joint(self) -> Array:
        """The share of the worst told parameter of each joint (n,), NaN for a joint without any.

        Small where it moved too little or alike.
        """
        return np.array([np.nan if k is None else self.by_parameter[k] for k in self.worst])

    @property
    def _n_joints(self) -> int:
        return self.base.n_standard // (10 + self.base.drive.columns_per_joint)


def information_efficiency(
    model: RobotModel, drive: DriveSet, samples: JointStates
) -> InformationEfficiency:
    """Return how much of the attainable information per sample the states of a recording carry, for
    equal noise in all joints.

    Limits that the description lacks are those of `MotionBounds.assumed`. Long recordings are
    thinned evenly. Raises UsageError without samples.
    """
    step = max(1, -(-len(samples.q) // MOST_SAMPLES))
    q, qd, qdd = (
        np.ascontiguousarray(x[::step], dtype=np.float64)
        for x in (samples.q, samples.qd, samples.qdd)
    )
    if not len(q):
        raise UsageError("there are no samples to judge")
    base, bound = _bound(model, drive)
    mean = mean_information(Information.of(model, base), q, qd, qdd)
    best = np.diag(np.linalg.inv(bound.information))
    size = np.sqrt(np.maximum(np.diag(bound.information), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(mean / np.outer(size, size))
    kept = eigenvalues > len(mean) * np.finfo(float).eps * eigenvalues[-1]
    own = ((vectors[:, kept] ** 2) / eigenvalues[kept]).sum(axis=1) / size**2
    told = (vectors[:, ~kept] ** 2).sum(axis=1) < 1e-6
    by_parameter = np.where(told, best / np.maximum(own, np.finfo(float).tiny), 0.0)
    return InformationEfficiency(
        base, bound.efficiency(mean) if np.all(kept) else 0.0, by_parameter
    )


@lru_cache(maxsize=8)
def _bound(model: RobotModel, drive: DriveSet) -> tuple[BaseParameters, InformationBound]:
    base = find_base_parameters(model, drive)
    limits = MotionBounds.assumed(model)
    with one_blas_thread():
        return base, information_bound(
            model,
            Information.of(model, base),
            limits,
            torque=MotionBounds.of(model).torque,
            rounds=ROUNDS,
        )
