"""What can only be looked at once the extremes and the clock of a recording are known.

A second pass, stretch by stretch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.experiment.quality.first_pass import Survey, as_modelled, believable
from asbuilt.experiment.recording import Recording

_FEW = 20
"""Fewer fresh samples than this have no extremes to stay at."""
_NEAR = 0.05
"""What is near an extreme, in parts of the span between both."""


@dataclass(frozen=True, eq=False)
class Plateau:
    """How often a torque is at its extreme.

    The places among the fresh samples, how many are near it, and their different values.
    """

    extreme: float
    width: float
    places: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    n_near: int = 0
    near: Array = field(default_factory=lambda: np.zeros(0))

    def with_more(self, values: Array, begin: int) -> Plateau:
        """Take in further fresh values (N,), the first of which is at place `begin`."""
        near = values[np.abs(values - self.extreme) < self.width]
        places = begin + np.flatnonzero(values == self.extreme)
        return replace(
            self,
            places=np.append(self.places, places),
            n_near=self.n_near + near.size,
            near=np.union1d(self.near, near) if near.size else self.near,
        )


@dataclass(frozen=True, eq=False)
class CloserLook:
    """Hold the samples of chosen pieces, the torques by which filters are found, and the plateaus
    at both extremes of every joint, none where it hardly varies.
    """

    pieces: tuple[Recording, ...]
    torques: tuple[Array, ...]
    plateaus: tuple[tuple[Plateau, ...], ...]


def look_closer(
    model: RobotModel, stretches: Iterable[Recording], known: Survey, rows: Sequence[Indices]
) -> CloserLook:
    """Go through the stretches again for pieces of consecutive `rows`, and for torques that stay at
    their extremes.

    The torques of a recording that is held are all of them, those of one in several stretches those
    of the pieces.
    """
    plateaus = [_plateaus(known, k) for k in range(known.n_joints)]
    parts: list[list[Recording]] = [[] for _ in rows]
    torques: list[Array] = []
    begin = place = 0
    for logged in stretches:
        stretch = believable(as_modelled(model, logged))
        stop = begin + stretch.n_samples
        fresh = stretch.tau[known.fresh[begin:stop]]
        plateaus = [
            tuple(each.with_more(fresh[:, k], place) for each in both)
            for k, both in enumerate(plateaus)
        ]
        for wanted, part in zip(rows, parts, strict=True):
            here = wanted[np.searchsorted(wanted, begin) : np.searchsorted(wanted, stop)]
            if here.size:
                part.append(_copied(stretch, here - begin))
        if known.n_stretches == 1:
            torques.append(stretch.tau[known.heard])
        begin, place = stop, place + len(fresh)
    pieces = tuple(_joined(part) for part in parts)
    return CloserLook(
        pieces, tuple(torques) or tuple(piece.tau for piece in pieces), tuple(plateaus)
    )


def _plateaus(known: Survey, joint: int) -> tuple[Plateau, ...]:
    low, high = float(known.effort.low[joint]), float(known.effort.high[joint])
    if known.effort.count[joint] < _FEW or high == low:
        return ()
    return Plateau(high, _NEAR * (high - low)), Plateau(low, _NEAR * (high - low))


def _copied(stretch: Recording, rows: Indices) -> Recording:
    return Recording(
        t=stretch.t[rows],
        q=stretch.q[rows],
        tau=stretch.tau[rows],
        qd=None if stretch.qd is None else stretch.qd[rows],
        joint_names=stretch.joint_names,
        source=stretch.source,
    )


def _joined(parts: Sequence[Recording]) -> Recording:
    t, q, tau = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "q", "tau")
    )
    logged = [part.qd for part in parts if part.qd is not None]
    qd = np.concatenate(logged) if len(logged) == len(parts) else None
    return replace(parts[0], t=t, q=q, tau=tau, qd=qd)
