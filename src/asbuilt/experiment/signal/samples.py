"""Samples: motion and torque on a uniform clock, divided into training and held-out ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array, Mask, find_true_ranges
from asbuilt.dynamics.reactions import Reactions
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.recording import EncoderSide, TorqueSource
from asbuilt.findings import join_names

if TYPE_CHECKING:
    from asbuilt.experiment.signal.parallel_filter import ParallelFilter
from asbuilt.findings import Cure
from asbuilt.ranges import Range

Segments = tuple[tuple[int, int], ...]
AT_ONCE = 32_768
"""Samples of a long recording whose torques are predicted or filtered at once."""


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """Hold prepared samples in SI units, all joints at the same times.

    Parameters
    ----------
    t
        Times [s], shape (N,).
    q, qd, qdd, tau
        Positions, velocities, accelerations and torques before the parallel filter, (N, n).
    rate
        Sampling rate [Hz] within a segment.
    joint_names
        Names of the n joints.
    segments
        Half-open index ranges of contiguous samples, by default all; there are gaps between them.
        Samples outside of them do not count.
    source, torque_source
        Name of the recording, and what measured the torque.
    parallel
        Filter still to be applied, segment by segment, to torque and regressor columns alike.
    tau_raw
        Torque as logged, unfiltered, (N, n), by default `tau`.
    origin
        Time [s] at which the recording began before trimming, by default at the first sample;
        time blocks count from it.
    provenance
        Sentences about what was done.
    delay
        Delays [s] by which the torque was shifted back, one for all joints or each; empty: none.
    delay_errors
        Standard errors [s] of delays that were estimated, which the errors of a fit allow for.
    clock_bound
        Largest error of the clock, as a share, that logged velocities admit; infinite without them.
    slowest
        Speed of each joint below which its rows do not count, since the direction of dry friction
        is unknown; infinite for a joint without a torque channel; empty: all count.
    reactions
        Where forces act that nobody measured, or may, and in which units equations are without
        them; by default none do.
    pose_noise
        Variance of the acceleration of each joint, after all filters, by white noise of the
        positions, of robots with reactions; empty: unknown.
    encoder, encoder_at
        Position, velocity and acceleration by a second encoder of each joint, (3, N, n), and its
        side of the drive train, "motor" or "link"; None: joints have one encoder.

    Raises
    ------
    RecordingError
        If shapes do not agree or segments are not ordered index ranges.

    Examples
    --------
    >>> t, x = np.arange(6.0), np.zeros((6, 1))
    >>> samples = Samples(t, x, x, x, x, rate=1.0, joint_names=("j",), segments=((0, 2), (3, 6)))
    >>> samples.select(np.array([1, 1, 1, 1, 1, 0], bool)).segments
    ((0, 2), (2, 4))
    >>> samples
    Samples('samples': 6 samples x 1 joints (j), 5 s at 1 Hz in 2 segments)
    """

    t: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    rate: float
    joint_names: tuple[str, ...]
    segments: Segments = ()
    source: str = "samples"
    torque_source: TorqueSource = "unknown"
    parallel: ParallelFilter | None = None
    tau_raw: Array = field(default_factory=lambda: np.empty((0, 0)))
    origin: float = np.nan
    provenance: tuple[str, ...] = ()
    delay: tuple[float, ...] = ()
    delay_errors: tuple[float, ...] = ()
    slowest: tuple[float, ...] = ()
    clock_bound: float = np.inf
    reactions: Reactions = Reactions()  # noqa: RUF009 - frozen
    pose_noise: tuple[float, ...] = ()
    encoder: Array | None = None
    encoder_at: EncoderSide = "link"

    def __post_init__(self) -> None:
        t = _freeze(self.t)
        segments = tuple((int(a), int(b)) for a, b in self.segments) or ((0, t.size),)
        # In order and without overlap, from the first sample to the last.
        ends = [0, *(edge for segment in segments for edge in segment), t.size]
        shape = (t.size, len(self.joint_names))
        expected: dict[str, tuple[Array | None, tuple[int, ...]]] = {
            "q": (self.q, shape),
            "qd": (self.qd, shape),
            "qdd": (self.qdd, shape),
            "tau": (self.tau, shape),
            "tau_raw": (self.tau_raw if self.tau_raw.size else self.tau, shape),
            "encoder": (self.encoder, (3, *shape)),
        }
        arrays = {name: _freeze(x) for name, (x, _) in expected.items() if x is not None}
        if t.ndim != 1 or t.size == 0:
            raise RecordingError(
                f"{self.source}: t must be a vector of at least one time, got shape {t.shape}"
            )
        for name, array in arrays.items():
            if array.shape != expected[name][1]:
                raise RecordingError(
                    f"{self.source}: {name} must have shape {expected[name][1]} for {t.size}"
                    f" samples of {shape[1]} joints, got {array.shape}"
                )
        if self.reactions.n_samples not in (None, t.size):
            raise RecordingError(
                f"{self.source}: reactions are known at {self.reactions.n_samples} times, and there"
                f" are {t.size} samples"
            )
        if any(later < earlier for earlier, later in pairwise(ends)):
            raise RecordingError(
                f"{self.source}: segments must be ordered index ranges within 0 to {t.size}, got"
                f" {list(segments)}"
            )
        origin = float(t[0]) if np.isnan(self.origin) else self.origin
        settled = {"t": t, "segments": segments, "origin": origin, **arrays}
        for name, value in settled.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return (
            f"Samples({self.source!r}: {self.n_samples} samples x {self.n_joints} joints"
            f" ({join_names(self.joint_names)}), {self.duration:.4g} s at {self.rate:.4g} Hz in"
            f" {len(self.segments)} segments)"
        )

    @property
    def n_samples(self) -> int:
        """Number of samples, before the parallel filter's decimation."""
        return int(self.t.size)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    @property
    def has_computed_torque(self) -> bool:
        """Whether its torque was not measured, but is what a law makes of commands."""
        return self.torque_source == "command"

    @property
    def has_torque(self) -> Mask:
        """Which joints have a usable torque channel, shape (n,)."""
        return np.isfinite(self.slowest or np.zeros(self.n_joints))

    @property
    def n_filtered(self) -> int:
        """Number of samples after the parallel filter, the rows per joint of identification."""
        return sum(self._n_outputs(b - a) for a, b in self.segments)

    @property
    def duration(self) -> float:
        """Time covered by the segments [s]."""
        return sum(b - a for a, b in self.segments) / self.rate

    @property
    def filtered_times(self) -> Array:
        """Times of the filtered samples [s], shape (n_filtered,)."""
        return np.concatenate(
            [
                self.parallel.times(self.t[a:b]) if self.parallel else self.t[a:b]
                for a, b in self.segments
            ]
        )

    @property
    def filtered_torque(self) -> Array:
        """Torque after the parallel filter, shape (n_filtered, n): what identification fits."""
        return self.filtered(self.tau)

    def filtered(self, x: Array) -> Array:
        """Apply the parallel filter to x (N, ...), segment by segment, giving (n_filtered, ...)."""
        if self.parallel is None:
            return self.in_segments(x)
        return self.filtered_spans(x[span] for span in self.spans())

    def filtered_spans(self, values: Iterable[Array]) -> Array:
        """Return filtered values (n_filtered, ...) of those on each of `spans`, (L, ...) in order.

        What is evaluated span by span takes no memory for all samples.
        """
        if self.parallel is None:
            return np.concatenate(list(values))
        step = self.parallel.decimation
        width = self.parallel.taps.size
        every = iter(values)
        parts = []
        for segment in self.segments:
            held = None
            for _ in _divide_span(*segment):
                new = next(every)
                held = new if held is None else np.concatenate([held, new])
                count = self._n_outputs(len(held))
                # Segments that are too short still contribute an array of no rows.
                seen = held[: max(count - 1, 0) * step + width]
                parts.append(self.parallel.apply(seen, axis=0))
                # The window of the next output begins here.
                held = held[count * step :]
        return np.concatenate(parts)

    def in_segments(self, x: Array) -> Array:
        """Return x (N, ...) at the samples of segments alone."""
        # Nothing is left out: no copy.
        if sum(b - a for a, b in self.segments) == len(x):
            return x
        parts = [x[a:b] for a, b in self.segments]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def spans(self) -> Iterator[slice]:
        """Yield spans of contiguous samples that together are all of segments, some at a time."""
        for segment in self.segments:
            yield from _divide_span(*segment)

    def within(self, keep: NDArray[np.bool_]) -> Samples:
        """Return the same arrays with those parts of segments where `keep` (N,) is true."""
        mask = np.asarray(keep)
        if mask.dtype != np.bool_ or mask.shape != self.t.shape:
            raise UsageError(
                f"a selection is one truth value for each of {self.n_samples} samples, got"
                f" {mask.dtype} of shape {mask.shape}"
            )
        ranges = tuple(
            (a + first, a + last)
            for a, b in self.segments
            for first, last in find_true_ranges(mask[a:b])
        )
        if not ranges:
            raise RecordingError(
                f"{self.source}: no sample is left of {self.n_samples} between {self.t[0]:g} s and"
                f" {self.t[-1]:g} s"
            )
        return replace(self, segments=ranges)

    def select(self, keep: NDArray[np.bool_]) -> Samples:
        """Return the samples where `keep` (N,) is true; contiguous ones remain one segment."""
        return self.within(keep).compact()

    def compact(self) -> Samples:
        """Return the samples of segments alone."""
        if sum(b - a for a, b in self.segments) == self.n_samples:
            return self
        names = ("t", "q", "qd", "qdd", "tau", "tau_raw")
        kept = {name: self.in_segments(getattr(self, name)) for name in names}
        if self.encoder is not None:
            # An axis for position, velocity and acceleration stands first.
            kept["encoder"] = np.stack([self.in_segments(x) for x in self.encoder])
        rows = np.concatenate([np.arange(a, b) for a, b in self.segments])
        bounds = [0, *np.cumsum([b - a for a, b in self.segments]).tolist()]
        return replace(
            self,
            **cast(Any, kept),
            reactions=self.reactions.at(rows),
            segments=tuple(pairwise(bounds)),
        )

    def between(self, start: float, stop: float) -> Samples:
        """Return the samples with `start <= t < stop` [s]."""
        return self.select((self.t >= start) & (self.t < stop))

    def outside(self, windows: Sequence[tuple[float, float]]) -> Samples:
        """Return the samples outside the half-open windows (start, stop) [s]."""
        keep = np.ones(self.n_samples, dtype=bool)
        for start, stop in windows:
            keep &= (self.t < start) | (self.t >= stop)
        return self.select(keep)

    def _n_outputs(self, n_inputs: int) -> int:
        return self.parallel.n_outputs(n_inputs) if self.parallel else n_inputs


def _divide_span(start: int, stop: int) -> Iterator[slice]:
    """Yield spans of at most `AT_ONCE` samples."""
    for first in range(start, stop, AT_ONCE):
        yield slice(first, min(first + AT_ONCE, stop))


def _freeze(value: ArrayLike) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.flags.writeable:
        array = array.view()
        array.setflags(write=False)
    return array


SHORTEST_DIVIDED = 6.0
"""Length of a recording [s] below which it is cut in two by default: filters leave too little of
shorter blocks, each of which borders at both ends on motion that is fitted."""
HALF = "last:0.5"
RECORDINGS = "recordings"
"""Rule by which whole recordings are left out in turn, each predicted by a fit to the others."""
FORMS = "blocks:5s:3 (every third 5 s block) or last:0.3 (the last 30 %)"


@dataclass(frozen=True, slots=True)
class Blocks:
    """Hold out the last of every so many blocks of so many seconds."""

    seconds: float
    every: int


@dataclass(frozen=True, slots=True)
class Last:
    """Hold out the last share of the time."""

    share: float


BLOCKS = Range(1e-3, 1e6, "s")
EVERY = Range(2, 1e6)
"""What lengths and numbers of blocks may be; a log has at most a million of either."""


def parse_rule(rule: str) -> Blocks | Last:
    """Return the rule of `hold_out` that a text stands for.

    Raises
    ------
    UsageError
        If it is none.

    Examples
    --------
    >>> parse_rule("blocks:5s:3")
    Blocks(seconds=5.0, every=3)
    """
    kind, *arguments = rule.strip().split(":")
    if kind == "blocks" and len(arguments) == 2:
        seconds = _parse_number(arguments[0].removesuffix("s"), rule, "a block length in seconds")
        every = _parse_number(arguments[1], rule, "every how many blocks one is held out")
        if not BLOCKS.holds(seconds) or every != int(every) or not EVERY.holds(every):
            raise UsageError(
                f"cannot hold out {rule!r}: blocks have a length {BLOCKS} and a whole number"
                f" {EVERY}, as in {FORMS}",
                value=rule,
            )
        return Blocks(seconds, int(every))
    if kind == "last" and len(arguments) == 1:
        share = _parse_number(arguments[0], rule, "a share of the time")
        if not 0 < share < 1:
            raise UsageError(
                f"cannot hold out {rule!r}: the share must lie between 0 and 1, as in {FORMS}",
                value=rule,
            )
        return Last(share)
    raise UsageError(f"cannot hold out {rule!r}: give {FORMS}", value=rule)


def choose_usual_rule(seconds: float) -> str | None:
    """Return the rule that holds out a third of a recording of this length; None if too short.

    Blocks of 5 s, of a shorter recording a sixth of it, so that two are held out.

    >>> choose_usual_rule(60.0), choose_usual_rule(15.0), choose_usual_rule(4.0)
    ('blocks:5s:3', 'blocks:2.5s:3', None)
    """
    if seconds < SHORTEST_DIVIDED:
        return None
    # A third of six sixths: two blocks are held out; to a tenth of a second for reading.
    return f"blocks:{min(5.0, np.floor(10.0 * seconds / 6.0) / 10.0):g}s:3"


def hold_out(samples: Samples, rule: str, *, shared: bool = False) -> tuple[Samples, Samples]:
    """Divide samples into training and held-out ones.

    Time counts from the beginning of the recording, so the division does not depend on what the
    filters trimmed. Every border ends a segment, so the parallel filter, which drops outputs
    without `margin` inputs on either side, does not mix torques of the two parts.

    Parameters
    ----------
    samples
        The samples.
    rule
        `"blocks:5s:3"` holds out every third block of 5 s, `"last:0.3"` the last 30 % of the time.
    shared
        Whether both parts are segments of the same arrays, which takes no memory.

    Returns
    -------
    train, held_out : Samples
        Every sample is in exactly one of them.

    Raises
    ------
    UsageError
        If the rule cannot be read.
    RecordingError
        If one part would be empty.

    Examples
    --------
    >>> t, x = np.arange(30.0), np.zeros((30, 1))
    >>> samples = Samples(t, x, x, x, x, rate=1.0, joint_names=("elbow",))
    >>> [part.n_samples for part in hold_out(samples, "blocks:5s:3")]
    [20, 10]
    """
    since = samples.t - samples.origin
    chosen = parse_rule(rule)
    if isinstance(chosen, Blocks):
        held = (
            # Rounding of times must not move the first sample of a block into the one before.
            np.floor(since / chosen.seconds + 1e-9).astype(int) % chosen.every == chosen.every - 1
        )
    else:
        # The last sample lasts one period.
        held = since >= (1.0 - chosen.share) * (since[-1] + 1.0 / samples.rate) - 1e-9
    if held.all() or not held.any():
        raise RecordingError(
            f"{samples.source}: holding out {rule!r} leaves nothing to"
            f" {'train' if held.all() else 'validate'} on in {since[-1]:.3g} s",
            cure=Cure("give shorter blocks"),
            file=samples.source,
            value=rule,
        )
    if shared:
        return samples.within(~held), samples.within(held)
    return samples.select(~held), samples.select(held)


def _parse_number(text: str, rule: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UsageError(
            f"cannot hold out {rule!r}: {text!r} is not {what}; give {FORMS}", value=rule
        )
    return value
