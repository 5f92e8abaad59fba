"""What has to be known of every single sample before a recording is judged, gathered stretch by
stretch, so that the recording need not be held.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.quality.running_statistics import Extremes, Furthest, Likeness
from asbuilt.experiment.recording import Recording, TorqueSource, median_rate, time_span

CREDIBLE = {"position": 1e6, "torque": 1e9, "velocity": 1e6, "acceleration": 1e9}
"""Largest value that any robot could log, in any unit of the quantity."""
LIMIT_MARGIN = 0.01
"""How far beyond its limits [rad or m] a joint may be logged."""
FULL_TORQUE = 0.99
"""Part of its limit from which a torque is said to reach it."""


@dataclass(frozen=True, eq=False)
class Missing:
    """The rows in which the column of one quantity and joint holds no usable number, and what
    stands in the first.
    """

    quantity: str
    joint: int
    rows: Indices
    first: float


@dataclass(frozen=True, eq=False)
class Survey:
    """Hold what one pass over all samples of a recording tells of it.

    `t` (N,) are its times; `fresh` (N,) says which samples differ from the one before in position
    or torque, `heard` which have a time and torques, `usable` which have positions and, where
    logged, velocities, too. `reach` has the extremes of the positions, `effort` those of fresh
    torques; `beyond` counts positions outside the limits of the model, `loud` fresh torques that
    reach theirs. Values that no robot could log count as missing.
    """

    source: str
    joint_names: tuple[str, ...]
    torque_source: TorqueSource
    notes: tuple[str, ...]
    n_stretches: int
    first_torque: float
    t: Array
    fresh: NDArray[np.bool_]
    heard: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    missing: tuple[Missing, ...]
    reach: Extremes
    likeness: Likeness
    beyond: Furthest
    effort: Extremes
    loud: Furthest

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]: the inverse of the median positive time step.

        NaN where there is none.
        """
        return median_rate(self.t)

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]."""
        return time_span(self.t)


def survey(model: RobotModel, stretches: Iterable[Recording]) -> Survey:
    """Go once through the stretches of a recording in order, or through one that is held, a single
    stretch.

    Raises RecordingError where there is no stretch, or its joints are not those of the model.
    """
    n = model.n_joints
    lower, upper = _position_limits(model)
    full = FULL_TORQUE * np.array([joint.limits.torque for joint in model.joints])
    reach, effort, likeness, beyond, loud = (
        Extremes.none(n),
        Extremes.none(n),
        Likeness.none(n),
        Furthest.none(n),
        Furthest.none(n),
    )
    times, flags, missing = [], [], list[Missing]()
    first = last = None
    begin = 0
    for logged in stretches:
        stretch = as_modelled(model, logged)
        fresh = _fresh(stretch, last)
        missing += _missing(stretch, begin)
        last, stretch = stretch, believable(stretch)
        first = first or stretch
        q, tau = stretch.q, stretch.tau
        heard = np.isfinite(stretch.t) & np.all(np.isfinite(tau), axis=1)
        usable = (
            heard
            & np.all(np.isfinite(q), axis=1)
            & (stretch.qd is None or np.all(np.isfinite(stretch.qd), axis=1))
        )
        times.append(np.array(stretch.t))
        flags.append(np.stack([fresh, heard, usable]))
        rows = np.arange(begin, begin + stretch.n_samples)
        outside = np.maximum(lower - q, q - upper)
        size = np.abs(tau[fresh])
        reach, effort, likeness = (
            reach.with_more(q),
            effort.with_more(tau[fresh]),
            likeness.with_more(q),
        )
        beyond = beyond.with_more(outside, outside > LIMIT_MARGIN, q, rows)
        loud = loud.with_more(size, size >= full, tau[fresh], rows[fresh])
        begin += stretch.n_samples
    if first is None:
        raise RecordingError("a recording without a stretch holds no samples")
    fresh, heard, usable = np.concatenate(flags, axis=1)
    return Survey(
        source=first.source,
        joint_names=first.joint_names,
        torque_source=first.torque_source,
        notes=first.notes,
        n_stretches=len(times),
        first_torque=float(first.tau[0, 0]),
        t=np.concatenate(times),
        fresh=fresh,
        heard=heard,
        usable=usable,
        missing=_united(missing),
        reach=reach,
        likeness=likeness,
        beyond=beyond,
        effort=effort,
        loud=loud,
    )


def as_modelled(model: RobotModel, recording: Recording) -> Recording:
    """Return the recording with its joints in the order of the model.

    Raises RecordingError where they are not those of the model.
    """
    if recording.n_joints != model.n_joints:
        raise RecordingError(
            f"{recording.source} has {recording.n_joints} joints"
            f" ({', '.join(recording.joint_names)}) but {model.name} has {model.n_joints}"
            f" ({', '.join(model.joint_names)}); choose the right robot, or read the recording with"
            " model = ..."
        )
    if recording.joint_names != model.joint_names and set(recording.joint_names) == set(
        model.joint_names
    ):
        return recording.reordered(model.joint_names)
    return recording


def believable(recording: Recording) -> Recording:
    """Return the recording with NaN in place of values that no robot could log, so that no other
    check stumbles over them.
    """

    def cleaned(what: str, values: Array) -> Array:
        return np.where(np.abs(values) <= CREDIBLE[what], values, np.nan)

    if not any(
        np.nanmax(np.abs(values), initial=0.0) > CREDIBLE[what]
        for what, values in _quantities(recording)
    ):
        return recording
    return replace(
        recording,
        q=cleaned("position", recording.q),
        tau=cleaned("torque", recording.tau),
        qd=None if recording.qd is None else cleaned("velocity", recording.qd),
        qdd=None if recording.qdd is None else cleaned("acceleration", recording.qdd),
    )


def _quantities(recording: Recording) -> Iterator[tuple[str, Array]]:
    yield "position", recording.q
    yield "torque", recording.tau
    if recording.qd is not None:
        yield "velocity", recording.qd
    if recording.qdd is not None:
        yield "acceleration", recording.qdd


def _position_limits(model: RobotModel) -> tuple[Array, Array]:
    endless = [joint.kind == "continuous" for joint in model.joints]
    lower = np.where(endless, -np.inf, [joint.limits.lower for joint in model.joints])
    return lower, np.where(endless, np.inf, [joint.limits.upper for joint in model.joints])


def _fresh(stretch: Recording, before: Recording | None) -> NDArray[np.bool_]:
    """Say which samples differ from the one before, the first from the last of the stretch before."""
    changed = np.any(np.diff(stretch.q, axis=0) != 0, axis=1) | np.any(
        np.diff(stretch.tau, axis=0) != 0, axis=1
    )
    first = before is None or bool(
        np.any(stretch.q[0] != before.q[-1]) or np.any(stretch.tau[0] != before.tau[-1])
    )
    return np.concatenate([[first], changed])


def _missing(stretch: Recording, begin: int) -> Iterator[Missing]:
    for what, values in _quantities(stretch):
        bad = ~(np.abs(values) <= CREDIBLE[what])
        for k in np.flatnonzero(bad.any(axis=0)).tolist():
            rows = np.flatnonzero(bad[:, k])
            yield Missing(what, k, begin + rows, float(values[rows[0], k]))


def _united(missing: list[Missing]) -> tuple[Missing, ...]:
    """Return what is missing of each column once, quantity by quantity."""
    found: dict[tuple[int, int], list[Missing]] = {}
    for each in missing:
        found.setdefault((list(CREDIBLE).index(each.quantity), each.joint), []).append(each)
    return tuple(
        replace(parts[0], rows=np.concatenate([part.rows for part in parts]))
        for _, parts in sorted(found.items(), key=lambda item: item[0])
    )
