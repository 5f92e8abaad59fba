"""Two passes over a recording: statistics of every sample, then segments and torque extremes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask, find_true_rows
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.quality.reductions import (
    Exceedance,
    Extremes,
    PositionMoments,
    SmoothedMotion,
    choose_segments,
    smooth_motion,
)
from asbuilt.experiment.recording import (
    Recording,
    find_changed_rows,
    join_recordings,
    median_rate,
    time_span,
)
from asbuilt.experiment.signal.prepared_motion import Spikes, find_spikes
from asbuilt.findings import Cure

CREDIBLE = {
    "position": 1e6,
    "command": 1e6,
    "torque": 1e9,
    "velocity": 1e6,
    "acceleration": 1e9,
    "second encoder": 1e6,
}
"""Largest value that any robot could log, in any unit of the quantity."""


@dataclass(frozen=True, eq=False)
class Missing:
    """Hold the rows in which one column has no usable number, and the value in the first."""

    quantity: str
    joint: int
    rows: Indices
    first: float


@dataclass(frozen=True, eq=False)
class FirstPass:
    """Hold statistics over all samples of a recording.

    Parameters
    ----------
    first
        The first chunk as logged, its joints in the order of the model.
    t
        Times [s], shape (N,).
    not_repeated
        Whether position or torque differ from the sample before, shape (N,).
    valid_torque
        Whether time and torques are finite, shape (N,).
    valid
        Whether positions and, if logged, velocities are finite too, shape (N,).
    missing
        Columns with values that are not finite or that no robot could log.
    position_range, torque_range
        Extremes of the positions, and of the torques that are not repeated.
    moments
        Moments of the positions.
    spikes
        Single torques that stand out from their neighbours.
    outside_limits, saturated
        Positions outside the limits of the model, and torques that reach theirs.
    """

    first: Recording
    n_chunks: int
    t: Array
    not_repeated: Mask
    valid_torque: Mask
    valid: Mask
    missing: tuple[Missing, ...]
    position_range: Extremes
    moments: PositionMoments
    outside_limits: Exceedance
    torque_range: Extremes
    saturated: Exceedance
    spikes: tuple[Spikes, ...] = ()

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.first.n_joints

    @property
    def rate(self) -> float:
        """Inverse of the median positive time step [Hz]; NaN if there is none."""
        return median_rate(self.t)

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]."""
        return time_span(self.t)


def run_first_pass(model: RobotModel, chunks: Iterable[Recording]) -> FirstPass:
    """Read the consecutive chunks of a recording once (a recording in memory is one chunk).

    Raises
    ------
    RecordingError
        If there is no chunk, or the joints are not the model's.
    """
    lower, upper = position_limits(model)
    # Share of its limit from which a torque counts as saturated.
    full = 0.99 * np.array([joint.limits.torque for joint in model.joints])
    positions = Extremes()
    torques = Extremes()
    moments = PositionMoments()
    outside = Exceedance()
    saturated = Exceedance()
    # Flags of all samples are kept, a bit each; values are not.
    times = []
    flags = []
    spikes = list[Spikes]()
    missing: dict[tuple[int, int], Missing] = {}
    first = last = None
    begin = 0
    for logged in chunks:
        chunk = order_as_modelled(model, logged)
        first = first or chunk
        # A joint that has torque in the first chunk has it in all.
        chunk = chunk.with_torque_of(first.has_torque)
        not_repeated = _mark_not_repeated(chunk, last)
        _add_missing(missing, chunk, begin)
        # The chunk as logged decides repetition, before values are blanked.
        last = chunk
        chunk = blank_incredible(chunk)
        q = chunk.q
        tau = chunk.tau
        valid_torque = np.isfinite(chunk.t) & ~find_true_rows(~np.isfinite(tau))
        valid = valid_torque & ~find_true_rows(~np.isfinite(q))
        if chunk.qd is not None:
            valid &= ~find_true_rows(~np.isfinite(chunk.qd))
        times.append(np.array(chunk.t))
        flags.append(np.stack([not_repeated, valid_torque, valid]))
        rows = np.arange(begin, begin + chunk.n_samples)
        # Torques of a command jump with it: no spikes.
        if chunk.torque_source != "command":
            spikes += [
                replace(spike, rows=begin + spike.rows) for spike in find_spikes(tau, not_repeated)
            ]
        # Positive beyond the one limit or the other.
        excess = np.maximum(lower - q, q - upper)
        size = np.abs(tau[not_repeated])
        positions = positions.with_more(q)
        moments = moments.with_more(q)
        # Repeated samples would count a plateau twice.
        torques = torques.with_more(tau[not_repeated])
        # Distance beyond its limits [rad or m] at which a joint counts as outside them.
        outside = outside.with_more(excess, excess > 0.01, q, rows)
        saturated = saturated.with_more(size, size >= full, tau[not_repeated], rows[not_repeated])
        begin += chunk.n_samples
    if first is None or last is None:
        raise RecordingError("the recording holds no samples")
    not_repeated, valid_torque, valid = np.concatenate(flags, axis=1)
    return FirstPass(
        # Notes count over all chunks up to their own: those of the last one are of the whole log.
        first=replace(first, notes=last.notes),
        n_chunks=len(times),
        t=np.concatenate(times),
        not_repeated=not_repeated,
        valid_torque=valid_torque,
        valid=valid,
        missing=tuple(missing[key] for key in sorted(missing)),
        position_range=positions,
        moments=moments,
        outside_limits=outside,
        torque_range=torques,
        saturated=saturated,
        spikes=tuple(spikes),
    )


def order_as_modelled(model: RobotModel, recording: Recording) -> Recording:
    """Return the recording with its joints in the order of the model.

    Raises
    ------
    RecordingError
        If the joints are not the model's.
    """
    if recording.n_joints != model.n_joints:
        raise RecordingError(
            f"{recording.source} has {recording.n_joints} joints"
            f" ({', '.join(recording.joint_names)}) but {model.name} has {model.n_joints}"
            f" ({', '.join(model.joint_names)})",
            cure=Cure(
                "choose the robot that was recorded, or read the recording with its model",
                call="read_recording",
            ),
            file=recording.source,
            value=recording.n_joints,
            expected=model.n_joints,
        )
    if recording.joint_names != model.joint_names and set(recording.joint_names) == set(
        model.joint_names
    ):
        # The same names in another order are read by name.
        return recording.reordered(model.joint_names)
    return recording


def blank_incredible(recording: Recording) -> Recording:
    """Return the recording with NaN in place of values that no robot could log."""

    def cleaned(what: str, values: Array) -> Array:
        return np.where(np.abs(values) <= CREDIBLE[what], values, np.nan)

    # The usual log has nothing to blank, and is not copied.
    if not any(
        np.nanmax(np.abs(values), initial=0.0) > CREDIBLE[what]
        for what, values in _list_quantities(recording)
    ):
        return recording
    return replace(
        recording,
        q=cleaned("position", recording.q),
        tau=cleaned("torque", recording.tau),
        qd=None if recording.qd is None else cleaned("velocity", recording.qd),
        qdd=None if recording.qdd is None else cleaned("acceleration", recording.qdd),
    )


def _list_quantities(recording: Recording) -> Iterator[tuple[str, Array]]:
    """Yield what was logged by its name; torques of a servo are computed from its command."""
    yield "position", recording.q
    if recording.servo is not None and recording.command is not None:
        yield "command", recording.command
    else:
        yield "torque", recording.tau
    if recording.qd is not None:
        yield "velocity", recording.qd
    if recording.qdd is not None:
        yield "acceleration", recording.qdd
    # Comparing with a sample before, also across chunks.
    if recording.second_encoder is not None:
        positions = recording.second_encoder[1]
        # Joints may be without a second encoder.
        yield "second encoder", np.where(np.isnan(positions), 0.0, positions)


def position_limits(model: RobotModel) -> tuple[Array, Array]:
    """Return the lower and upper limits of the positions [rad or m], each (n,)."""
    endless = [joint.kind == "continuous" for joint in model.joints]
    return (
        np.where(endless, -np.inf, [joint.limits.lower for joint in model.joints]),
        np.where(endless, np.inf, [joint.limits.upper for joint in model.joints]),
    )


def _mark_not_repeated(chunk: Recording, before: Recording | None) -> Mask:
    """Return which samples differ from the one before, the first from the last of `before`."""
    if before is None:
        return find_changed_rows(chunk.q, chunk.tau)
    q, tau = (
        np.concatenate([x[-1:], y]) for x, y in ((before.q, chunk.q), (before.tau, chunk.tau))
    )
    # The first row was the last of the chunk before.
    return find_changed_rows(q, tau)[1:]


def _add_missing(missing: dict[tuple[int, int], Missing], chunk: Recording, begin: int) -> None:
    """Add the rows of a chunk, which begins at row `begin`, by quantity and joint."""
    for what, values in _list_quantities(chunk):
        bad = ~(np.abs(values) <= CREDIBLE[what])
        for k in np.flatnonzero(bad.any(axis=0)).tolist():
            rows = np.flatnonzero(bad[:, k])
            key = (list(CREDIBLE).index(what), k)
            # NaN fails the comparison, and counts as missing too.
            known = missing.get(key) or Missing(what, k, rows[:0], float(values[rows[0], k]))
            missing[key] = replace(known, rows=np.append(known.rows, begin + rows))


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
        return replace(
            self,
            places=np.append(self.places, begin + np.flatnonzero(values == self.extreme)),
            n_near=self.n_near + near.size,
            near=np.union1d(self.near, near) if near.size else self.near,
        )


@dataclass(frozen=True, eq=False)
class SecondPass:
    """Hold the motion in chosen segments, the torques for spectra, and the plateaus of each joint.

    There is no motion where no segment is long enough. A joint whose torque hardly varies has no
    plateaus, others one at each extreme.
    """

    motion: SmoothedMotion | None
    torques: tuple[Array, ...]
    plateaus: tuple[tuple[Plateau, ...], ...]


def run_second_pass(model: RobotModel, chunks: Iterable[Recording], known: FirstPass) -> SecondPass:
    """Read the chunks again for segments of consecutive rows and for torques at their extremes.

    The torques for spectra are all torques of one chunk, else the torques of the segments.
    """
    rows, step, window = choose_segments(known.t, known.valid)
    plateaus = [_find_plateaus(known, k) for k in range(known.n_joints)]
    parts: list[list[Recording]] = [[] for _ in rows]
    torques: list[Array] = []
    begin = place = 0
    for logged in chunks:
        chunk = blank_incredible(
            order_as_modelled(model, logged).with_torque_of(known.first.has_torque)
        )
        stop = begin + chunk.n_samples
        changed = chunk.tau[known.not_repeated[begin:stop]]
        plateaus = [
            tuple(plateau.with_more(changed[:, k], place) for plateau in both)
            for k, both in enumerate(plateaus)
        ]
        for wanted, part in zip(rows, parts, strict=True):
            # Rows of a segment that lie in this chunk; a segment may span two.
            here = wanted[np.searchsorted(wanted, begin) : np.searchsorted(wanted, stop)]
            if here.size:
                part.append(chunk.taken(here - begin))
        if known.n_chunks == 1:
            torques.append(chunk.tau[known.valid_torque])
        # Plateaus count torques that are not repeated, and not samples.
        begin = stop
        place = place + len(changed)
    segments = list(map(join_recordings, parts))
    motion = smooth_motion(segments, step, window) if segments else None
    return SecondPass(
        motion, tuple(torques) or tuple(part.tau for part in segments), tuple(plateaus)
    )


def _find_plateaus(known: FirstPass, joint: int) -> tuple[Plateau, ...]:
    low = float(known.torque_range.low[joint])
    high = float(known.torque_range.high[joint])
    # Number of torques that are not repeated below which there is no plateau.
    if known.torque_range.count[joint] < 20 or high == low:
        return ()
    # One at each extreme, with a twentieth of the range as its neighbourhood.
    return Plateau(high, _NEAR * (high - low)), Plateau(low, _NEAR * (high - low))
