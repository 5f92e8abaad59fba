"""Two passes over a recording: statistics of every sample, then segments and torque extremes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask, find_true_rows
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.quality.reductions import (
    Clock,
    Exceedance,
    Extremes,
    PositionMoments,
    Repeats,
    SmoothedMotion,
    choose_segments,
    smooth_motion,
)
from asbuilt.experiment.recording import (
    Recording,
    find_changed_rows,
    join_recordings,
)
from asbuilt.experiment.signal.resampling import find_spikes
from asbuilt.findings import Cure

Bits = np.ndarray[tuple[int], np.dtype[np.uint8]]
"""Flags of samples, eight in a byte."""
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
    """Hold the rows in which one column has no usable number, and value and time of the first."""

    quantity: str
    joint: int
    rows: Indices
    first: float
    time: float


@dataclass(frozen=True, eq=False)
class TimedSpikes:
    """Hold when the torque of a joint (from 0) stands out [s], and by how much."""

    joint: int
    times: Array
    sizes: Array


@dataclass(frozen=True, eq=False)
class FirstPass:
    """Hold statistics over all samples of a recording.

    Parameters
    ----------
    first
        The first chunk as logged, its joints in the order of the model.
    clock
        What is asked of the times of all samples, and the times of some.
    repeats
        How many samples differ in position or torque from the sample before.
    not_repeated
        Which samples do, a bit each, of every chunk.
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
    clock: Clock
    repeats: Repeats
    not_repeated: tuple[Bits, ...]
    missing: tuple[Missing, ...]
    position_range: Extremes
    moments: PositionMoments
    outside_limits: Exceedance
    torque_range: Extremes
    saturated: Exceedance
    spikes: tuple[TimedSpikes, ...] = ()

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return self.clock.n_samples

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.first.n_joints

    @property
    def rate(self) -> float:
        """Inverse of the median positive time step [Hz]; NaN if there is none."""
        return 1.0 / self.clock.step

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]."""
        return self.clock.duration


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
    clock = Clock()
    repeats = Repeats()
    # A bit for every sample: the second pass need not compare again.
    bits = []
    spikes = list[TimedSpikes]()
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
        t = chunk.t
        if not_repeated.all():
            changed = chunk.tau
            changed_t = t
        else:
            # Repeated samples would count a plateau twice.
            changed = chunk.tau[not_repeated]
            changed_t = t[not_repeated]
        clock = clock.with_more(t, _mark_valid(chunk))
        repeats = repeats.with_more(not_repeated, begin)
        bits.append(np.packbits(not_repeated))
        # Computed torques jump with what they follow from: no spikes.
        if not chunk.has_computed_torque:
            spikes += [
                TimedSpikes(spike.joint, t[spike.rows], spike.sizes)
                for spike in find_spikes(chunk.tau, not_repeated)
            ]
        # Positive beyond the one limit or the other.
        excess = np.maximum(lower - q, q - upper)
        size = np.abs(changed)
        positions = positions.with_more(q)
        moments = moments.with_more(q)
        torques = torques.with_more(changed)
        # Distance beyond its limits [rad or m] at which a joint counts as outside them.
        outside = outside.with_more(excess, excess > 0.01, q, t)
        saturated = saturated.with_more(size, size >= full, changed, changed_t)
        begin += chunk.n_samples
    if first is None or last is None:
        raise RecordingError("the recording holds no samples")
    return FirstPass(
        # Notes count over all chunks up to their own: those of the last one are of the whole log.
        first=replace(first, notes=last.notes),
        clock=clock,
        repeats=repeats.ended(begin),
        not_repeated=tuple(bits),
        missing=tuple(missing[key] for key in sorted(missing)),
        position_range=positions,
        moments=moments,
        outside_limits=outside,
        torque_range=torques,
        saturated=saturated,
        spikes=tuple(spikes),
    )


def _mark_valid(chunk: Recording) -> Mask:
    """Return in which samples (N,) time, torques, positions and logged velocities are finite."""
    valid = np.isfinite(chunk.t)
    for values in (chunk.tau, chunk.q, chunk.qd):
        if values is None:
            continue
        finite = np.isfinite(values)
        # The usual log lacks nothing, and needs no look at its rows.
        if not finite.all():
            valid &= ~find_true_rows(~finite)
    return valid


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
    if all(_is_credible(what, values) for what, values in _list_quantities(recording)):
        return recording
    return replace(
        recording,
        q=cleaned("position", recording.q),
        tau=cleaned("torque", recording.tau),
        qd=None if recording.qd is None else cleaned("velocity", recording.qd),
        qdd=None if recording.qdd is None else cleaned("acceleration", recording.qdd),
    )


def _is_credible(what: str, values: Array) -> bool:
    """Return whether all values are such as a robot logs; NaN is none."""
    # NaN makes an extreme NaN, which compares as false.
    return not values.size or bool(
        values.max() <= CREDIBLE[what] and values.min() >= -CREDIBLE[what]
    )


def _list_quantities(recording: Recording) -> Iterator[tuple[str, Array]]:
    """Yield what was logged by its name: the command where torques were computed from it."""
    yield "position", recording.q
    if recording.drive_law is not None and recording.command is not None:
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


def still_ranges(model: RobotModel) -> Array:
    """Return the range of positions [rad or m] below which each joint hardly moves, (n,)."""
    return np.array([0.05 if joint.is_revolute else 0.005 for joint in model.joints])


def _mark_not_repeated(chunk: Recording, before: Recording | None) -> Mask:
    """Return which samples differ from the one before, the first from the last of `before`."""
    changed = find_changed_rows(chunk.q, chunk.tau)
    if before is not None:
        changed[:1] = np.any(before.q[-1] != chunk.q[:1]) or np.any(before.tau[-1] != chunk.tau[:1])
    return changed


def _add_missing(missing: dict[tuple[int, int], Missing], chunk: Recording, begin: int) -> None:
    """Add the rows of a chunk, which begins at row `begin`, by quantity and joint."""
    for what, values in _list_quantities(chunk):
        if _is_credible(what, values):
            continue
        # NaN fails the comparison, and counts as missing too.
        bad = ~(np.abs(values) <= CREDIBLE[what])
        for k in np.flatnonzero(bad.any(axis=0)).tolist():
            rows = np.flatnonzero(bad[:, k])
            key = (list(CREDIBLE).index(what), k)
            known = missing.get(key) or Missing(
                what, k, rows[:0], float(values[rows[0], k]), float(chunk.t[rows[0]])
            )
            missing[key] = replace(known, rows=np.append(known.rows, begin + rows))


_NEAR = 0.05
"""Distance from an extreme, as a share of the torque range, that counts as near it."""


@dataclass(frozen=True, eq=False)
class Plateau:
    """Hold how often a torque is at one of its extremes, and how often near it.

    `places` are indices among the torques that are not repeated, `times` theirs [s]. `near` are
    different values near the extreme; of very many a share, 1 / 2^halvings, chosen by their bits.
    """

    extreme: float
    width: float
    places: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    times: Array = field(default_factory=lambda: np.zeros(0))
    n_near: int = 0
    near: Array = field(default_factory=lambda: np.zeros(0))
    halvings: int = 0

    @property
    def n_values(self) -> int:
        """Number of different values near the extreme, about where they are very many."""
        return int(self.near.size) << self.halvings

    def with_more(self, values: Array, t: Array, begin: int) -> Plateau:
        """Include further torques (N,) and their times, the first of which has index `begin`."""
        close = values[np.abs(values - self.extreme) < self.width]
        if not close.size:
            return self
        at = np.flatnonzero(values == self.extreme)
        near = np.union1d(self.near, close[_pick_share(close, self.halvings)])
        halvings = self.halvings
        # What one chunk holds is counted exactly.
        while self.n_near and near.size > _MOST_VALUES:
            halvings += 1
            near = near[_pick_share(near, halvings)]
        return replace(
            self,
            places=np.append(self.places, begin + at),
            times=np.append(self.times, t[at]),
            n_near=self.n_near + close.size,
            near=near,
            halvings=halvings,
        )


_MOST_VALUES = 1000
"""Different values near an extreme that are kept: their number is then right to some 5 per cent."""


def _pick_share(values: Array, halvings: int) -> Mask:
    """Return which values (N,) belong to a share, 1 / 2^halvings, that holds equal ones together.

    Multiplied by an odd number (of the golden ratio, Knuth 1973), high bits depend on all bits.
    """
    if not halvings:
        return np.ones(values.shape, dtype=bool)
    bits = np.ascontiguousarray(values).view(np.uint64)
    mixed = (bits ^ (bits >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
    return np.asarray(mixed >> np.uint64(64 - halvings) == 0)


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
    rows, step, window = choose_segments(known.clock)
    plateaus = [_find_plateaus(known, k) for k in range(known.n_joints)]
    parts: list[list[Recording]] = [[] for _ in rows]
    torques: list[Array] = []
    begin = place = 0
    for logged, bits in zip(chunks, known.not_repeated, strict=True):
        chunk = blank_incredible(
            order_as_modelled(model, logged).with_torque_of(known.first.has_torque)
        )
        stop = begin + chunk.n_samples
        changed = np.unpackbits(bits, count=chunk.n_samples).view(bool)
        tau = np.ascontiguousarray(chunk.tau.T if changed.all() else chunk.tau[changed].T)
        t = chunk.t if changed.all() else chunk.t[changed]
        plateaus = [
            tuple(plateau.with_more(tau[k], t, place) for plateau in both)
            for k, both in enumerate(plateaus)
        ]
        for wanted, part in zip(rows, parts, strict=True):
            # Rows of a segment that lie in this chunk; a segment may span two.
            here = wanted[np.searchsorted(wanted, begin) : np.searchsorted(wanted, stop)]
            if here.size:
                part.append(chunk.taken(here - begin))
        if known.clock.n_chunks == 1:
            usable = np.isfinite(chunk.t) & ~find_true_rows(~np.isfinite(chunk.tau))
            torques.append(chunk.tau[usable])
        # Plateaus count torques that are not repeated, and not samples.
        begin = stop
        place = place + t.size
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
