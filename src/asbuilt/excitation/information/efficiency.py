"""Information efficiency of a recorded motion."""

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
"""Most samples of a recording that are used; of longer ones every second, third, ..."""

ROUNDS = 3
"""Rounds of the bound for a recording, accurate to a few per cent."""


class JointStates(Protocol):
    """Joint states `q`, `qd`, `qdd` (N, n), such as the samples of a recording."""

    @property
    def q(self) -> Array:
        """Positions."""

    @property
    def qd(self) -> Array:
        """Velocities."""

    @property
    def qdd(self) -> Array:
        """Accelerations."""


@dataclass(frozen=True, eq=False, repr=False)
class InformationEfficiency:
    """Information of a motion per sample relative to an upper bound that no motion reaches.

    The bound is the best distribution over the states within the limits. `d_efficiency` is
    `exp((log det M - log det M_bound) / p)`, 0 if a parameter remains undetermined. `by_parameter`
    (p,) is the variance of each base parameter at the bound over that of the motion; it may exceed
    1 for some.
    """

    base: BaseParameters
    d_efficiency: float
    by_parameter: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_parameter", read_only(self.by_parameter))

    def __repr__(self) -> str:
        return f"InformationEfficiency({self.base.robot!r}, d_efficiency={self.d_efficiency:.3f})"

    @property
    def owners(self) -> NDArray[np.intp]:
        """Joint, counted from 0, of the link or drive of each base parameter (p,)."""
        columns, per = self.base.columns, self.base.drive.columns_per_joint
        return np.where(
            columns < 10 * self._n_joints,
            columns // 10,
            (columns - 10 * self._n_joints) // max(per, 1),
        )

    @property
    def worst(self) -> tuple[int | None, ...]:
        """Worst determined base parameter of each joint, None for a joint without any."""
        own = [np.flatnonzero(self.owners == k) for k in range(self._n_joints)]
        return tuple(
            int(each[np.argmin(self.by_parameter[each])]) if each.size else None for each in own
        )

    @property
    def by_joint(self) -> Array:
        """Efficiency of the worst determined parameter of each joint (n,), NaN without any.

        It is small if the joint moved too little or correlated with others.
        """
        return np.array([np.nan if k is None else self.by_parameter[k] for k in self.worst])

    @property
    def _n_joints(self) -> int:
        return self.base.n_standard // (10 + self.base.drive.columns_per_joint)


def information_efficiency(
    model: RobotModel, drive: DriveSet, samples: JointStates
) -> InformationEfficiency:
    """Return the information efficiency of recorded states, for equal noise in all joints.

    Limits that the description lacks are those of `MotionBounds.assumed`. Long recordings are
    thinned evenly. Raises `UsageError` without samples.
    """
    step = max(1, -(-len(samples.q) // MOST_SAMPLES))
    q, qd, qdd = (
        np.ascontiguousarray(x[::step], dtype=np.float64)
        for x in (samples.q, samples.qd, samples.qdd)
    )
    if not len(q):
        raise UsageError("the recording has no samples")
    base, bound = _bound(model, drive)
    mean = mean_information(Information.of(model, base), q, qd, qdd)
    best = np.diag(np.linalg.inv(bound.information))
    size = np.sqrt(np.maximum(np.diag(bound.information), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(mean / np.outer(size, size))
    kept = eigenvalues > len(mean) * np.finfo(float).eps * eigenvalues[-1]
    own = ((vectors[:, kept] ** 2) / eigenvalues[kept]).sum(axis=1) / size**2
    determined = (vectors[:, ~kept] ** 2).sum(axis=1) < 1e-6
    by_parameter = np.where(determined, best / np.maximum(own, np.finfo(float).tiny), 0.0)
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
