"""Radius of feet that roll: by how much the ground touches them below the frame that names them.

The centre of a ball that rolls on level ground without slipping moves as `d(x, y) = r (w_y, -w_x)
dt`, where a point that stands does not move at all. So pose and joints alone say on which radius a
foot stands. Forces that act there have another moment than at its centre: legs of 16 cm of which
the lowest 2 are rubber turn by 0.5 rad in a step, and the moment is off by as much as 1 cm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.contact import SAMPLES_AT_ONCE, contact_jacobians
from asbuilt.experiment.recording import Recording


@dataclass(frozen=True, slots=True)
class RollingRules:
    """Say when a foot is taken to roll: own choices, tested on virtual robots and a Solo12.

    The foot is followed over pieces of stance of up to `longest` [s] and at least `samples`
    samples, less an `edge` of every stance at both ends, where it lands and lifts. At least
    `pieces` of them are needed, and in the median piece rolling leaves less than `left` of the
    squared displacement. At most `read` samples of a recording are looked at; radii are `smallest`
    to `largest` [m].
    """

    longest: float = 0.5
    edge: float = 1.0 / 6.0
    samples: int = 5
    pieces: int = 5
    left: float = 0.5
    smallest: float = 2e-3
    largest: float = 0.2
    read: int = 20_000


ROLLING = RollingRules()


def set_rolling_radii(model: RobotModel, recordings: Sequence[Recording]) -> RobotModel:
    """Return a robot whose contacts of unstated radius have that on which they roll, if any."""
    unstated = [each.radius is None and not each.flat for each in model.contacts]
    if not any(unstated):
        return model
    radii = estimate_rolling_radii(model, recordings)
    return replace(
        model,
        contacts=tuple(
            replace(each, radius=radius) if open_ and radius else each
            for each, radius, open_ in zip(model.contacts, radii, unstated, strict=True)
        ),
    )


def estimate_rolling_radii(
    model: RobotModel, recordings: Sequence[Recording]
) -> list[float | None]:
    """Return the radius [m] on which each contact rolls; None where it does not show one."""
    flat = replace(
        model, contacts=tuple(replace(each, flat=True, radius=0.0) for each in model.contacts)
    )
    pieces: list[list[tuple[Array, Array]]] = [[] for _ in model.contacts]
    for recording in recordings:
        part = recording.taken(slice(0, ROLLING.read))
        readable = np.isfinite(part.rate) and bool(np.all(np.isfinite(part.q)))
        if part.contact is None or model.n_floating != 6 or not readable:
            continue
        for own, moved, closed in zip(
            pieces, _sum_displacements(flat, part.q), part.contact.T > 0.5, strict=True
        ):
            own.extend(_cut_stance_segments(moved, closed, part.rate))
    return [_estimate_radius(own) for own in pieces]


def _sum_displacements(model: RobotModel, q: Array) -> Array:
    """Return the sums of displacements and turns (n_contacts, N, 6) of each contact's frame."""
    steps = [np.zeros((len(model.contacts), 1, 6))]
    for start in range(0, len(q) - 1, SAMPLES_AT_ONCE):
        own = q[start : start + SAMPLES_AT_ONCE + 1]
        J = np.stack(contact_jacobians(model, own))
        middle = 0.5 * (J[:, 1:] + J[:, :-1])
        steps.append(np.einsum("csij,sj->csi", middle, np.diff(own, axis=0)))
    return np.cumsum(np.concatenate(steps, axis=1), axis=1)


def _cut_stance_segments(moved: Array, closed: Mask, rate: float) -> Iterator[tuple[Array, Array]]:
    """Yield displacement and what a radius of 1 m would give, (2 n,) each, of pieces of stance."""
    changes = np.flatnonzero(np.diff(np.r_[False, closed, False].astype(np.int8)))
    for start, stop in changes.reshape(-1, 2).tolist():
        edge = round(ROLLING.edge * (stop - start))
        stance = moved[start + edge : stop - edge]
        parts = max(1, round(len(stance) / (ROLLING.longest * rate)))
        for piece in np.array_split(stance, parts):
            if len(piece) >= ROLLING.samples:
                off = piece - piece.mean(axis=0)
                yield off[:, :2].ravel(), np.stack([off[:, 4], -off[:, 3]], axis=1).ravel()


def _estimate_radius(pieces: Sequence[tuple[Array, Array]]) -> float | None:
    """Return the median radius, weighted by the turns of pieces, if the foot rolls on it."""
    if len(pieces) < ROLLING.pieces:
        return None
    turns = np.array([x @ x for _, x in pieces])
    radii = np.array([y @ x for y, x in pieces]) / np.maximum(turns, 1e-30)
    order = np.argsort(radii)
    half = np.searchsorted(np.cumsum(turns[order]), 0.5 * turns.sum())
    radius = float(radii[order][half])
    left = [np.sum((y - radius * x) ** 2) / max(float(y @ y), 1e-30) for y, x in pieces]
    rolls = ROLLING.smallest < radius < ROLLING.largest and np.median(left) < ROLLING.left
    return round(radius, 4) if rolls else None
