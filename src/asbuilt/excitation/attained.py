"""How much of the attainable information a recorded motion carries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import UsageError
from asbuilt.excitation.information import Information, mean_information
from asbuilt.excitation.information_bound import InformationBound, information_bound
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motion import Array, read_only

MOST_SAMPLES = 20000
ROUNDS = 3
"""Rounds in which the bound is tightened: a recording is judged to a few per cent, a design more sharply."""


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
    """Compare a motion with the best distribution over the states that the limits admit, sample for sample.

    `d_efficiency` is `exp((log det M - log det M_bound) / p)`, 0 where the motion leaves a parameter untold. `by_parameter` (p,) is the variance
    that the best distribution gives each base parameter over the variance that the motion gives it; it may exceed 1 for some.
    `by_joint` (n,) is its smallest value over the parameters of that link and drive: small where the joint moved too little or alike.
    """

    base: BaseParameters
    d_efficiency: float
    by_parameter: Array
    by_joint: Array

    def __post_init__(self) -> None:
        for name in ("by_parameter", "by_joint"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def information_efficiency(model: RobotModel, drive: DriveSet, samples: JointStates) -> InformationEfficiency:
    """Return how much of the attainable information per sample the states of a recording carry, for equal noise in all joints.

    Limits that the description lacks are those of `MotionBounds.assumed`. Long recordings are thinned evenly. Raises UsageError without samples.
    """
    step = max(1, -(-len(samples.q) // MOST_SAMPLES))
    q, qd, qdd = (np.ascontiguousarray(x[::step], dtype=np.float64) for x in (samples.q, samples.qd, samples.qdd))
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
    per, links = drive.columns_per_joint, 10 * model.n_joints
    owner = np.where(base.columns < links, base.columns // 10, (base.columns - links) // max(per, 1))
    by_joint = np.array([by_parameter[owner == k].min() if np.any(owner == k) else np.nan for k in range(model.n_joints)])
    return InformationEfficiency(base, bound.efficiency(mean) if np.all(kept) else 0.0, by_parameter, by_joint)


@lru_cache(maxsize=8)
def _bound(model: RobotModel, drive: DriveSet) -> tuple[BaseParameters, InformationBound]:
    base = find_base_parameters(model, drive)
    limits = MotionBounds.assumed(model)
    with one_blas_thread():
        return base, information_bound(model, Information.of(model, base), limits, torque=MotionBounds.of(model).torque, rounds=ROUNDS)
