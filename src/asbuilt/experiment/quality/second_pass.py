"""Second pass over a recording: segments to smooth, and torques that stay at their extremes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.experiment.quality.first_pass import FirstPass, as_modelled, credible
from asbuilt.experiment.recording import Recording

_NEAR = 0.05
"""Distance from an extreme, as a share of the torque range, that counts as near it."""


@dataclass(frozen=True, eq=False)
class Plateau:
    """Hold how often a torque is at one of its extremes, and how often near it.

    `places` are indices among the torques that are not repeated; `near` are the different values
    near the extreme.
    """

    extreme: float
    width: float
    places: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    n_near: int = 0
    near: Array = field(default_factory=lambda: np.zeros(0))

    def with_more(self, values: Array, begin: int) -> Plateau:
        """Include further torques (N,), the first of which has the index `begin`."""
        near = values[np.abs(values - self.extreme) < self.width]
        places = begin + np.flatnonzero(values == self.extreme)
        return replace(
            self,
            places=np.append(self.places, places),
            n_near=self.n_near + near.size,
            near=np.union1d(self.near, near) if near.size else self.near,
        )


@dataclass(frozen=True, eq=False)
class SecondPass:
    """Hold the samples of chosen segments, the torques for spectra, and the plateaus of each joint.

    A joint whose torque hardly varies has no plateaus, others one at each extreme.
    """

    segments: tuple[Recording, ...]
    torques: tuple[Array, ...]
    plateaus: tuple[tuple[Plateau, ...], ...]


def second_pass(
    model: RobotModel, chunks: Iterable[Recording], known: FirstPass, rows: Sequence[Indices]
) -> SecondPass:
    """Read the chunks again for segments of consecutive `rows` and for torques at their extremes.

    The torques for spectra are all of those of one chunk, else those of the segments.
    """
    plateaus = [_plateaus(known, k) for k in range(known.n_joints)]
    parts: list[list[Recording]] = [[] for _ in rows]
    torques: list[Array] = []
    begin = place = 0
    for logged in chunks:
        chunk = credible(as_modelled(model, logged).with_torque_of(known.has_torque))
        stop = begin + chunk.n_samples
        changed = chunk.tau[known.not_repeated[begin:stop]]
        plateaus = [
            tuple(each.with_more(changed[:, k], place) for each in both)
            for k, both in enumerate(plateaus)
        ]
        for wanted, part in zip(rows, parts, strict=True):
            here = wanted[np.searchsorted(wanted, begin) : np.searchsorted(wanted, stop)]
            if here.size:
                part.append(_copied(chunk, here - begin))
        if known.n_chunks == 1:
            torques.append(chunk.tau[known.valid_torque])
        begin, place = stop, place + len(changed)
    segments = tuple(_joined(part) for part in parts)
    return SecondPass(
        segments, tuple(torques) or tuple(part.tau for part in segments), tuple(plateaus)
    )


def _plateaus(known: FirstPass, joint: int) -> tuple[Plateau, ...]:
    low, high = float(known.torque_range.low[joint]), float(known.torque_range.high[joint])
    # Number of torques that are not repeated below which there is no plateau.
    if known.torque_range.count[joint] < 20 or high == low:
        return ()
    return Plateau(high, _NEAR * (high - low)), Plateau(low, _NEAR * (high - low))


def _copied(chunk: Recording, rows: Indices) -> Recording:
    return Recording(
        t=chunk.t[rows],
        q=chunk.q[rows],
        tau=chunk.tau[rows],
        qd=None if chunk.qd is None else chunk.qd[rows],
        joint_names=chunk.joint_names,
        source=chunk.source,
    )


def _joined(parts: Sequence[Recording]) -> Recording:
    t, q, tau = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "q", "tau")
    )
    logged = [part.qd for part in parts if part.qd is not None]
    qd = np.concatenate(logged) if len(logged) == len(parts) else None
    return replace(parts[0], t=t, q=q, tau=tau, qd=qd)
