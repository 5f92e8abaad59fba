"""What a difference of parameters costs in torque, on the motion judged by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.identification.cause_evidence import CauseEvidence
from asbuilt.identification.triangular import triangular_factor

if TYPE_CHECKING:
    from asbuilt.dynamics.base_parameters import BaseParameters

Array = NDArray[np.float64]

TOLD = 1e-10
"""Squared singular value, relative to the largest with columns scaled alike, below which a direction makes no torque."""


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCost:
    """Hold, for each of p differences, RMS torques on the motion judged by.

    `torque` (p, n) = |W_kj d_j| / sqrt(N) of every joint k: what the difference alone does to the torque. `own` (p,) is the part, over all joints, that no change of the
    other parameters could make up for, and `total` (p,) = |W_j d_j| / sqrt(N) over all joints; where `own` is far below `total` the
    parameter trades off with others. `together` (n,) = |W_k d| / sqrt(N) is what all differences do together.
    """

    torque: Array
    total: Array
    own: Array
    together: Array


def torque_cost(evidence: CauseEvidence, base: BaseParameters, difference: Array) -> TorqueCost:
    """Return what differences (p,) of base parameters cost; NaN counts as none."""
    places = evidence.places(base.names)
    d = np.nan_to_num(difference, nan=0.0)
    rows = [factor[:, places] for factor in evidence.whole(evidence.judged)]
    n = evidence.n_judged
    torque = np.array([np.linalg.norm(W, axis=0) for W in rows]).T * np.abs(d)[:, None] / np.sqrt(n)
    stacked = triangular_factor(np.vstack(rows))
    length = np.linalg.norm(stacked, axis=0)
    present = length > 1e-12 * length.max(initial=0.0)
    scaled = stacked[:, present] / length[present]
    eigenvalues, vectors = np.linalg.eigh(scaled.T @ scaled)
    kept = eigenvalues > TOLD * eigenvalues.max(initial=0.0)
    variance = np.sum(vectors[:, kept] ** 2 / eigenvalues[kept], axis=1)
    hidden = np.sum(vectors[:, ~kept] ** 2, axis=1) > 1e-6
    own = np.zeros(len(d))
    own[present] = np.where(hidden, 0.0, length[present] * np.abs(d[present]) / np.sqrt(n * np.maximum(variance, 1e-300)))
    return TorqueCost(
        torque=torque,
        total=np.sqrt(np.sum(torque**2, axis=1)),
        own=own,
        together=np.array([np.linalg.norm(W @ d) for W in rows]) / np.sqrt(n),
    )
