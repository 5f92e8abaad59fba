"""Information efficiency of a recorded motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, read_only
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.excitation.information.information import Information, mean_information
from asbuilt.excitation.information.information_bound import InformationBound, information_bound
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.state_constraint import TorqueLimit

Limits = tuple[tuple[float, ...], ...]
"""Lower, upper, velocity, acceleration and torque limits of the joints."""


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

    The bound is the best distribution over the states within the limits, which are widened to hold
    every state of the motion: otherwise noise of the accelerations, or a wrong limit, would count
    as information beyond the bound. `d_efficiency` is `exp((log det M - log det M_bound) / p)`, 0
    if a parameter remains undetermined, never above 1. `by_parameter` (p,) is the variance of each
    base parameter at the bound over the motion's; it may exceed 1 for some. `beyond` (n,) is
    the largest factor by which each joint exceeds its limits, 1 within them.
    """

    base: BaseParameters
    d_efficiency: float
    by_parameter: Array
    beyond: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_parameter", read_only(self.by_parameter))
        object.__setattr__(self, "beyond", read_only(self.beyond))

    def __repr__(self) -> str:
        return f"InformationEfficiency({self.base.robot!r}, d_efficiency={self.d_efficiency:.3f})"

    @property
    def owners(self) -> NDArray[np.intp]:
        """Joint, counted from 0, of the link or drive of each base parameter (p,)."""
        columns, per = self.base.columns, self.base.drive.columns_per_joint
        links = 10 * self.base.n_links
        moved_by = np.array(self.base.link_joints)
        return np.where(
            columns < links,
            moved_by[np.minimum(columns, links - 1) // 10],
            (columns - links) // max(per, 1),
        )

    @property
    def worst(self) -> tuple[int | None, ...]:
        """Worst determined base parameter of each joint, None for a joint without any."""
        own = [np.flatnonzero(self.owners == k) for k in range(self.base.n_joints)]
        return tuple(
            int(each[np.argmin(self.by_parameter[each])]) if each.size else None for each in own
        )

    @property
    def by_joint(self) -> Array:
        """Efficiency of the worst determined parameter of each joint (n,), NaN without any.

        It is small if the joint moved too little or correlated with others.
        """
        return np.array([np.nan if k is None else self.by_parameter[k] for k in self.worst])


def information_efficiency(
    model: RobotModel, drive: DriveSet, samples: JointStates
) -> InformationEfficiency:
    """Return the information efficiency of recorded states, for equal noise in all joints.

    Limits that the description lacks come from `MotionBounds.assumed`; all are widened to the
    states recorded. Long recordings are thinned evenly. Raises `UsageError` without samples.
    """
    # Most samples of a recording that are used; of longer ones every second, third, ...
    step = max(1, -(-len(samples.q) // 20000))
    q, qd, qdd = (
        np.ascontiguousarray(x[::step], dtype=np.float64)
        for x in (samples.q, samples.qd, samples.qdd)
    )
    if not len(q):
        raise UsageError("the recording has no samples")
    widened, beyond = _widen_limits(model, q, qd, qdd)
    base, bound = _find_bound(model, drive, widened)
    mean = mean_information(Information.of(model, base), q, qd, qdd)
    best = np.diag(np.linalg.inv(bound.information))
    size = np.sqrt(np.maximum(np.diag(bound.information), np.finfo(float).tiny))
    eigenvalues, vectors = np.linalg.eigh(mean / np.outer(size, size))
    kept = eigenvalues > len(mean) * np.finfo(float).eps * eigenvalues[-1]
    own = ((vectors[:, kept] ** 2) / eigenvalues[kept]).sum(axis=1) / size**2
    determined = (vectors[:, ~kept] ** 2).sum(axis=1) < 1e-6
    by_parameter = np.where(determined, best / np.maximum(own, np.finfo(float).tiny), 0.0)
    return InformationEfficiency(
        base,
        min(bound.efficiency(mean), 1.0) if np.all(kept) else 0.0,
        by_parameter,
        beyond,
    )


def _widen_limits(model: RobotModel, q: Array, qd: Array, qdd: Array) -> tuple[Limits, Array]:
    """Return limits that hold all states, and by what factor each joint exceeds its own (n,).

    The factor is rounded up to a digit, so that like recordings share a bound.
    """
    limits = MotionBounds.assumed(model)
    fast, steep = np.abs(qd).max(axis=0), np.abs(qdd).max(axis=0)
    beyond = np.maximum(np.maximum(fast / limits.velocity, steep / limits.acceleration), 1.0)
    lower, upper = np.minimum(limits.lower, q.min(axis=0)), np.maximum(limits.upper, q.max(axis=0))
    velocity, acceleration = (
        limit * np.where(top > limit, np.ceil(10.0 * top / limit) / 10.0, 1.0)
        for limit, top in ((limits.velocity, fast), (limits.acceleration, steep))
    )
    torque, share = MotionBounds.of(model).torque, 1.0
    if np.any(np.isfinite(torque)):
        share = max(float(np.abs(TorqueLimit((model,), torque).values(q, qd, qdd)).max()), 1.0)
    arrays = (lower, upper, velocity, acceleration, torque * np.ceil(10.0 * share) / 10.0)
    return tuple(tuple(each.tolist()) for each in arrays), beyond


@lru_cache(maxsize=8)
def _find_bound(
    model: RobotModel, drive: DriveSet, widened: Limits
) -> tuple[BaseParameters, InformationBound]:
    base = find_base_parameters(model, drive)
    lower, upper, velocity, acceleration, torque = (np.array(each) for each in widened)
    limits = replace(
        MotionBounds.assumed(model),
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
    )
    with use_one_blas_thread():
        # Rounds of the bound for a recording, accurate to a few per cent.
        return base, information_bound(
            model, Information.of(model, base), limits, torque=torque, rounds=3
        )
