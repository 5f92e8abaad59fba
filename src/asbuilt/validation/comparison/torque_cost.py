"""What a difference of parameters costs in torque, on the motion judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.identification.information.cause_data import CauseData
from asbuilt.identification.information.triangular import triangular_factor

if TYPE_CHECKING:
    from asbuilt.dynamics.base.base_parameters import BaseParameters

Array = NDArray[np.float64]

TOLD = 1e-10
"""Squared singular value, relative to the largest with columns scaled alike, below which a
direction makes no torque.
"""
MATTERS = 0.5
"""Torque that a difference costs a joint, in multiples of the error left there as built, from which
it matters: the error would grow by an eighth.
"""
ABLE = 0.25
"""Part of the squared torque of a parameter, or of what another partner leaves of it, that a
partner makes up for, from which it is named,
"""
MOST_PARTNERS = 2
"""and how many are."""
SEVERAL = "several others"


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCost:
    """Hold, for each of p differences, RMS torques on the motion judged by.

    `torque` (p, n) = |W_kj d_j| / sqrt(N) of every joint k: what the difference alone does to the
    torque. `own` (p,) is the part, over all joints, that no change of the other parameters could
    make up for, and `total` (p,) = |W_j d_j| / sqrt(N) over all joints; where `own` is far below
    `total` the parameter trades off with others, and `partners` (p,) are the places of those that
    would do most of its work, the most able first. `together` (n,) = |W_k d| / sqrt(N) is what all
    differences do together.
    """

    torque: Array
    total: Array
    own: Array
    together: Array
    partners: tuple[tuple[int, ...], ...]

    @property
    def own_part(self) -> Array:
        """The part of the torque of each difference that is its own, (p,).

        1 where no other parameter could make up for any of it.
        """
        return np.divide(self.own, self.total, out=np.zeros_like(self.own), where=self.total > 0)

    def noticed(self, left: Array, *, alone: bool = False) -> NDArray[np.bool_]:
        """Whether a difference matters to some joint, (p,), beside the errors `left` (n,) there.

        `alone` counts only what is the parameter's own.
        """
        torque = self.torque * self.own_part[:, None] if alone else self.torque
        return np.asarray(np.any(torque >= MATTERS * left, axis=1))

    def shared_with(self, j: int, left: Array, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the partners of a parameter whose difference matters, but not alone,
        `SEVERAL` where it takes more than a few; none of another.
        """
        shared = self.noticed(left)[j] and not self.noticed(left, alone=True)[j]
        return (tuple(names[k] for k in self.partners[j]) or (SEVERAL,)) if shared else ()


def torque_cost(cause_data: CauseData, base: BaseParameters, difference: Array) -> TorqueCost:
    """Return what differences (p,) of base parameters cost; NaN counts as none."""
    places = cause_data.places(base.names)
    d = np.nan_to_num(difference, nan=0.0)
    rows = [factor[:, places] for factor in cause_data.whole(cause_data.judged)]
    n = cause_data.n_judged
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
    own[present] = np.where(
        hidden,
        0.0,
        length[present] * np.abs(d[present]) / np.sqrt(n * np.maximum(variance, 1e-300)),
    )
    return TorqueCost(
        torque=torque,
        total=np.sqrt(np.sum(torque**2, axis=1)),
        own=own,
        together=np.array([np.linalg.norm(W @ d) for W in rows]) / np.sqrt(n),
        partners=_partners(np.flatnonzero(present), scaled.T @ scaled, len(d)),
    )


def _partners(present: NDArray[np.int64], gram: Array, p: int) -> tuple[tuple[int, ...], ...]:
    """Return for each of p columns those that together imitate it best, one after the other, from
    the Gram matrix of the columns present, each of length 1.

    Orthogonal matching pursuit: each next column is the one most like what the others leave (Pati,
    Rezaiifar & Krishnaprasad, Asilomar 1993).
    """
    found: list[tuple[int, ...]] = [()] * p
    for j, place in enumerate(present):
        chosen: list[int] = []
        left = 1.0
        for _ in range(MOST_PARTNERS):
            weights = np.linalg.lstsq(gram[np.ix_(chosen, chosen)], gram[chosen, j], rcond=None)[0]
            likeness = np.abs(gram[:, j] - gram[:, chosen] @ weights)
            likeness[[j, *chosen]] = 0.0
            best = int(np.argmax(likeness))
            together = [*chosen, best]
            remaining = 1.0 - float(
                gram[j, together]
                @ np.linalg.lstsq(gram[np.ix_(together, together)], gram[together, j], rcond=None)[
                    0
                ]
            )
            if left - remaining < ABLE * left:
                break
            chosen, left = together, remaining
        found[place] = tuple(int(present[k]) for k in chosen)
    return tuple(found)
