"""Torque of a difference of parameters on the validation motion, and what it is shared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.identification.information.cause_data import CauseData
from asbuilt.identification.information.triangular import triangular_factor

if TYPE_CHECKING:
    from asbuilt.dynamics.base.base_parameters import BaseParameters

MATTERS = 0.5
"""Torque of a difference, relative to a joint's error as built, from which it matters: the error
would grow by an eighth; own choice."""
WEAKEST = 1e-10
"""Squared singular value, relative to the largest, below which a direction has no torque."""
ABLE = 0.25
"""Smallest part of the squared torque, or of what another partner leaves, of a named partner."""
MOST_PARTNERS = 2
SEVERAL = "several others"


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCost:
    r"""Hold RMS torques of p differences at n joints on the validation motion.

    | attribute | meaning |
    |---|---|
    | `torque` | (p, n) = \|W_kj d_j\| / sqrt(N) at every joint k |
    | `total` | (p,) = \|W_j d_j\| / sqrt(N) over all joints |
    | `own` | (p,) part of it that no change of the other parameters can make up for |
    | `together` | (n,) = \|W_k d\| / sqrt(N) of all differences |
    | `partners` | places of the parameters that could make up for most of the rest, best first |
    """

    torque: Array
    total: Array
    own: Array
    together: Array
    partners: tuple[tuple[int, ...], ...]

    @property
    def own_part(self) -> Array:
        """The part of each difference's torque that is its own, (p,)."""
        return np.divide(self.own, self.total, out=np.zeros_like(self.own), where=self.total > 0)

    def noticed(self, left: Array, *, alone: bool = False) -> Mask:
        """Return whether a difference matters beside the errors `left` (n,) of some joint, (p,).

        `alone` counts only its own part.
        """
        torque = self.torque * self.own_part[:, None] if alone else self.torque
        return np.asarray(np.any(torque >= MATTERS * left, axis=1))

    def shared_with(self, j: int, left: Array, names: Sequence[str]) -> tuple[str, ...]:
        """Return the partners of a parameter whose difference matters as a whole but not alone."""
        shared = self.noticed(left)[j] and not self.noticed(left, alone=True)[j]
        return (tuple(names[k] for k in self.partners[j]) or (SEVERAL,)) if shared else ()


def torque_cost(cause_data: CauseData, base: BaseParameters, difference: Array) -> TorqueCost:
    """Return the torque of differences (p,) of base parameters; NaN counts as none."""
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
    kept = eigenvalues > WEAKEST * eigenvalues.max(initial=0.0)
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


def _partners(present: Indices, gram: Array, p: int) -> tuple[tuple[int, ...], ...]:
    """Return for each column those that together replace it best, from the Gram matrix.

    Orthogonal matching pursuit: the next column is the one most correlated with what the others
    leave (Pati, Rezaiifar and Krishnaprasad, Asilomar 1993).
    """
    found: list[tuple[int, ...]] = [()] * p
    for j, place in enumerate(present):
        chosen: list[int] = []
        left = 1.0
        for _ in range(MOST_PARTNERS):
            weights = np.linalg.lstsq(gram[np.ix_(chosen, chosen)], gram[chosen, j], rcond=None)[0]
            correlation = np.abs(gram[:, j] - gram[:, chosen] @ weights)
            correlation[[j, *chosen]] = 0.0
            best = int(np.argmax(correlation))
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
