"""Resampling of a recording to segments without gaps on a uniform clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from asbuilt.arrays import Array, Indices, Mask, find_true_rows
from asbuilt.curves import CubicSpline
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording, find_advancing_rows, find_changed_rows
from asbuilt.findings import Cure

GAP = 4.5
"""Pause in the clock, in sampling periods, from which it is a gap."""
JITTER = 0.01
"""Largest deviation of a step of a uniform clock, in sampling periods."""
SHORTEST = 8
"""Number of samples below which a segment is dropped."""


@dataclass(frozen=True, eq=False)
class UniformSegment:
    """Hold a segment on a uniform clock: t (L,), q, tau and, if logged, qd and qdd (L, n).

    `tau` is the torque as recorded, at the times t; `qdd` is kept of robots with a free base.
    """

    t: Array
    q: Array
    tau: Array
    qd: Array | None
    qdd: Array | None = None


class Pause(NamedTuple):
    """Hold a pause before usable row `row`: times to fill in, samples `near` it, their times."""

    row: int
    times: Array
    near: slice
    near_times: Array


@dataclass(frozen=True, eq=False)
class Bridges:
    """Hold how the shorter pauses of a clock are filled, every channel alike.

    Parameters
    ----------
    usable
        Usable rows of the recording.
    pauses
        The pauses between them that are filled; if there is none, channels stay as they are.
    t, rows
        Times of the channels once they are filled, and their usable rows.

    Notes
    -----
    Every channel is fitted by a polynomial of degree 5 in least squares, over as many samples on
    either side as are missing, and at least 8: an interpolating spline would continue the slope of
    the noise.
    """

    usable: Indices
    pauses: tuple[Pause, ...]
    t: Array
    rows: Indices

    def fill(self, x: Array) -> Array:
        """Return a channel of the recording (N, n) with its pauses filled."""
        if not self.pauses:
            return x
        x = x[self.usable]
        return _insert(
            x,
            self.pauses,
            [_interpolate_locally(p.near_times, x[p.near], p.times) for p in self.pauses],
        )


@dataclass(frozen=True, eq=False)
class Grid:
    """Hold how rows of a recording become segments on a uniform clock, every channel alike.

    Parameters
    ----------
    recording
        The recording.
    bridges
        How its pauses are filled.
    segments
        Rows of each segment once pauses are bridged.
    clocks
        Times of these rows; None if segments are taken as they are.
    rate
        Rate of the uniform clock [Hz].
    notes
        Sentences about what was done.
    """

    recording: Recording
    bridges: Bridges
    # 1e-6: a last tick that rounding puts just beyond the end is kept.
    segments: tuple[Indices, ...]
    clocks: tuple[Array, ...] | None
    rate: float
    # Stamps within half a period of a uniform clock are that clock, rounded.
    notes: tuple[str, ...]

    def uniform(self) -> list[UniformSegment]:
        """Return the segments."""
        recording = self.recording
        q = self.channel(recording.q)
        tau = self.channel(recording.tau)
        qd = self._logged_channel(recording.qd)
        # The last tick may lie beyond the last sample by rounding: a spline must not extrapolate.
        qdd = self._logged_channel(recording.qdd if recording.undriven else None)
        times = map(self._times, range(len(self.segments)))
        return list(map(UniformSegment, times, q, tau, qd, qdd))

    def channel(self, x: Array) -> list[Array]:
        """Return a channel of the recording (N, n) in each segment, (L, n)."""
        filled = self.bridges.fill(x)
        return [self._on_clock(filled, k) for k in range(len(self.segments))]

    def _logged_channel(self, x: Array | None) -> list[Array | None]:
        """Return a channel in each segment, None if it was not logged, or not for every sample."""
        if x is None:
            return [None] * len(self.segments)
        # A polynomial through a pause with a missing sample would fill in nothing.
        filled = self.bridges.fill(x)
        return [
            self._on_clock(filled, k)
            if np.isfinite(filled[_simplify_indices(rows)]).all()
            else None
            for k, rows in enumerate(self.segments)
        ]

    def _times(self, k: int) -> Array:
        """Return the times of a segment on the uniform clock."""
        if self.clocks is not None:
            clock = self.clocks[k]
            count = int(np.floor((clock[-1] - clock[0]) * self.rate + 1e-6)) + 1
            return np.asarray(clock[0] + np.arange(count) / self.rate)
        part = self.bridges.t[_simplify_indices(self.segments[k])]
        even = part[0] + np.arange(part.size) / self.rate
        return np.asarray(even if np.max(np.abs(even - part)) < 0.5 / self.rate else part)

    def _on_clock(self, x: Array, k: int) -> Array:
        rows = self.segments[k]
        if self.clocks is None:
            return x[_simplify_indices(rows)]
        clock = self.clocks[k]
        inside = np.minimum(self._times(k), clock[-1])
        return CubicSpline(clock, x[rows])(inside)


def plan_uniform_grid(
    recording: Recording,
    rate: float | None = None,
    max_gap: float | None = None,
    resolved: float = 0.0,
) -> Grid:
    """Return how a recording becomes segments on a uniform clock.

    Rows that are not finite, rows whose time does not increase and rows that repeat the row before
    while the robot moves (a log polled faster than the controller writes) are dropped. A pause
    longer than `max_gap` [s] (by default 4.5 sampling periods, or `resolved` [s] if that is longer)
    ends a segment; shorter ones are bridged by local polynomials. An irregular clock, or one at
    another rate than `rate`, is resampled by cubic splines through the samples of the segment
    (error (5/384) h^4 x'''' at step h: Hall and Meyer, Journal of Approximation Theory, 1976).

    Raises
    ------
    RecordingError
        If nothing is left, or `rate` is far above the rate of the log.
    """
    n = recording.n_samples
    kept = np.isfinite(recording.t)
    for values in (recording.q, recording.tau):
        kept &= ~find_true_rows(~np.isfinite(values))
    notes: list[str] = []
    if not kept.all():
        notes.append(
            f"{n - int(kept.sum())} of {n} samples with NaN or infinite values were dropped"
        )
    later = find_advancing_rows(recording.t, kept)
    if not np.array_equal(later, kept):
        notes.append(
            f"{int(kept.sum() - later.sum())} samples whose time does not increase were dropped"
        )
    index = np.flatnonzero(later)
    kept_rows = _drop_repeats(recording, index)
    if kept_rows.size < index.size:
        notes.append(
            f"{index.size - kept_rows.size} samples that repeat the one before (the log was polled"
            " faster than the controller writes) were dropped"
        )
    if kept_rows.size < SHORTEST:
        raise RecordingError(
            f"{recording.source}: {kept_rows.size} of {n} samples are usable; at least {SHORTEST}"
            " are required",
            file=recording.source,
            value=kept_rows.size,
            lower=SHORTEST,
        )
    steps = np.diff(recording.t[kept_rows])
    period = float(np.median(steps))
    # The mean, as stamps are rounded: their median may be a multiple of the rounding.
    logged_rate = _round_rate(1.0 / float(np.mean(steps[steps <= GAP * period])))
    # A rate above the log's would invent samples.
    if rate is not None and rate > 1.05 * logged_rate:
        raise RecordingError(
            f"{recording.source}: a rate of {rate:g} Hz is above the rate of the log,"
            f" {logged_rate:g} Hz",
            cure=Cure("give a lower rate, or none"),
            file=recording.source,
            value=rate,
            upper=logged_rate,
        )
    gap = max(GAP * period, resolved) if max_gap is None else max_gap
    pause = GAP * period
    bridges = plan_bridges(recording.t, kept_rows, gap, pause)
    if bridges.pauses:
        longest = steps[[pause.row - 1 for pause in bridges.pauses]].max()
        notes.append(
            f"{len(bridges.pauses)} pauses of up to {longest:.3g} s, shorter than the filter"
            " resolves, were bridged by local polynomials"
        )
    stamps = bridges.t
    kept_rows = bridges.rows
    steps = np.diff(stamps[kept_rows])
    breaks = np.flatnonzero(steps > gap) + 1
    if breaks.size:
        notes.append(
            f"{breaks.size} gap{'s' * (breaks.size > 1)} longer than {gap:g} s (the longest"
            f" {steps.max():.3g} s) split the recording into {breaks.size + 1} segments"
        )
    segments = tuple(rows for rows in np.split(kept_rows, breaks) if rows.size >= SHORTEST)
    if not segments:
        raise RecordingError(
            f"{recording.source}: no segment of {SHORTEST} samples is without a gap of more than"
            f" {gap:g} s",
            # Where pauses end segments their steps say nothing of the clock.
            cure=Cure("check the clock"),
            file=recording.source,
        )
    target = logged_rate if rate is None else rate
    inside = np.delete(steps, breaks - 1)
    # A uniform clock is taken as it is: splines would only blur it.
    if np.all(np.abs(inside * target - 1.0) <= JITTER):
        return Grid(recording, bridges, segments, None, target, tuple(notes))
    q = bridges.fill(recording.q)
    clocks = [_choose_clock(stamps[rows], q[rows]) for rows in segments]
    ticks = sum(even for _, even in clocks)
    if rate is None and ticks == len(segments):
        target = _round_rate(
            1.0 / float(np.median([np.median(np.diff(clock)) for clock, _ in clocks]))
        )
    late = max(
        float(np.max(np.abs(clock - stamps[rows])))
        for rows, (clock, _) in zip(segments, clocks, strict=True)
    )
    if ticks and late > JITTER / target:
        notes.append(
            "the time stamps jitter, but the positions are smoother on a uniform clock, which was"
            " used"
        )
    if ticks < len(segments) or rate is not None:
        notes.append(
            f"a clock with steps of {1e3 * inside.min():.3g} to {1e3 * inside.max():.3g} ms was"
            f" resampled to {target:g} Hz by cubic splines"
        )
    times = tuple(clock for clock, _ in clocks)
    return Grid(recording, bridges, segments, times, target, tuple(notes))


def _drop_repeats(recording: Recording, index: Indices) -> Indices:
    """Drop exact repeats; those several times longer than usual are a robot at rest and stay.

    A second torque channel that changes makes a sample new. Under a command nothing is dropped: its
    torque is computed, and must not decide which samples there are.
    """
    if not index.size or recording.driving_command is not None:
        return index
    part = _simplify_indices(index)
    further = [channel for key, channel in recording.extra.items() if key.startswith("tau")]
    velocities = [] if recording.qd is None else [recording.qd]
    channels = (recording.q, recording.tau, *velocities, *further)
    changed = find_changed_rows(*(channel[part] for channel in channels))
    starts = np.flatnonzero(changed)
    lengths = np.diff(np.append(starts, index.size))
    # Long runs are rests, in which a controller writes the same values too.
    rest = np.repeat(lengths > GAP * np.median(lengths), lengths)
    return np.asarray(index[changed | rest])


def _simplify_indices(rows: Indices) -> Indices | slice:
    """Return increasing indices as a slice, which copies nothing, if none is left out."""
    if rows.size and rows[-1] - rows[0] + 1 == rows.size:
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows


def _round_rate(rate: float) -> float:
    # Below 20 Hz a whole number is not within 0.1 % by accident alone.
    """Return a rate rounded to a whole number within 0.1 %."""
    return float(round(rate)) if abs(rate - round(rate)) < 1e-3 * rate and rate > 20 else rate


def _choose_clock(t: Array, q: Array) -> tuple[Array, bool]:
    """Return the times of a segment: its stamps, or a uniform clock on which it is smoother.

    A controller that samples uniformly but is stamped by another process has stamps that jitter
    about its ticks; with them, speed times jitter would become position noise. Smoothness is the
    root mean square of the third difference on a uniform grid.
    """
    period = float(np.median(np.diff(t)))
    tick = _assign_ticks(t, period)
    if tick is None:
        return t, False
    slope, start = np.polyfit(tick, t - t[0], 1)
    even = t[0] + start + slope * tick
    # Beyond half a period stamps and ticks are not paired for certain.
    if np.max(np.abs(even - t)) > 0.6 * period:
        return t, False
    grid = np.arange(int(tick[-1]) + 1, dtype=np.float64)
    on_even = CubicSpline(tick, q)(grid)
    # Ticks just outside the stamps are moved to their ends.
    inside = t[0] + np.clip(start + slope * grid, 0.0, t[-1] - t[0])
    on_stamps = CubicSpline(t, q)(inside)
    roughness = [
        # Without the ends, at which splines are free.
        np.sqrt(np.mean(np.diff(x[1:-1], n=3, axis=0) ** 2, axis=0))
        for x in (on_even, on_stamps)
    ]
    return (
        (even, True)
        # The median over joints, since one at rest is as smooth on either clock.
        if np.median(roughness[0] / np.maximum(roughness[1], 1e-300)) < 1.0
        else (t, False)
    )


def _assign_ticks(t: Array, period: float) -> Array | None:
    """Return the clock tick (L,) of each stamp, None if the stamps follow no clock of this period.

    The phase of the stamps against the period is averaged on the circle over blocks of a few
    hundred stamps, so that a late stamp does not count as a lost sample, and unwrapped from block
    to block, so that the period need not be exact.
    """
    turns = (t - t[0]) / period
    blocks = np.array_split(np.arange(t.size), max(1, t.size // 256))
    means = np.array([np.mean(np.exp(2j * np.pi * turns[block])) for block in blocks])
    # Phases that scatter over the whole circle follow no clock of this period.
    if np.any(np.abs(means) < 0.3):
        return None
    centre = np.array([block.mean() for block in blocks])
    # Between blocks the phase drifts with the error of the period.
    phase = np.interp(np.arange(t.size), centre, np.unwrap(np.angle(means)) / (2.0 * np.pi))
    tick = np.rint(turns - phase)
    # Two stamps on one tick, or an order reversed: no clock.
    return tick - tick[0] if np.all(np.diff(tick) >= 1) else None


def plan_bridges(t: Array, usable: Indices, longest: float, pause: float) -> Bridges:
    """Return bridges of the pauses from `pause` to `longest` [s] between usable rows of times t."""
    logged = t[usable]
    steps = np.diff(logged)
    period = float(np.median(steps))
    pauses = []
    for place in np.flatnonzero((steps > pause) & (steps <= longest)).tolist():
        # Evenly between the ends, which need not be a whole number of periods apart.
        count = round(float(steps[place]) / period) - 1
        times = logged[place] + np.arange(1, count + 1) * (steps[place] / (count + 1))
        near = _select_around(logged, place, count, pause)
        pauses.append(Pause(place + 1, times, near, logged[near]))
    if not pauses:
        return Bridges(usable, (), t, usable)
    filled = _insert(logged, pauses, [pause.times for pause in pauses])
    return Bridges(usable, tuple(pauses), filled, np.arange(filled.size))


def _insert(x: Array, pauses: Sequence[Pause], filled: Sequence[Array]) -> Array:
    """Return usable rows (L, ...) with what fills each pause between them."""
    rows = np.repeat([times.row for times in pauses], [len(times) for times in filled])
    return np.insert(x, rows, np.concatenate(filled), axis=0)


def _select_around(t: Array, place: int, count: int, pause: float) -> slice:
    """Return the samples on either side of a pause, up to the next pause."""
    # Fewest samples on either side of a pause that the polynomial is fitted to.
    width = max(8, count)
    first = max(place + 1 - width, 0)
    last = min(place + 1 + width, t.size)
    earlier = np.flatnonzero(np.diff(t[first : place + 1]) > pause)
    later = np.flatnonzero(np.diff(t[place + 1 : last]) > pause)
    begin = first + int(earlier[-1]) + 1 if earlier.size else first
    return slice(begin, place + 2 + int(later[0]) if later.size else last)


def _interpolate_locally(t: Array, values: Array, times: Array) -> Array:
    """Return a polynomial through values (L, n) at other times (m, n)."""
    # Centred and of unit width: powers of times would lose their digits.
    centre = float(times.mean())
    half = max(float(np.ptp(t)) / 2.0, 1e-12)
    # Degree of the polynomial; a sine at the cutoff makes less than one turn in its window.
    degree = min(5, t.size - 1)
    fit = np.linalg.lstsq(np.vander((t - centre) / half, degree + 1), values, rcond=None)[0]
    return np.asarray(np.vander((times - centre) / half, degree + 1) @ fit)


NEIGHBOURS = np.array([-3, -2, -1, 2, 3, 4])
"""Steps next to the two of a spike, from the first of them."""
FEWEST_CHANGED = 20
"""Samples that differ from the one before, at least."""


@dataclass(frozen=True, slots=True, eq=False)
class Spikes:
    """Hold the rows at which the torque of a joint (from 0) stands out, and by how much."""

    joint: int
    rows: Indices
    sizes: Array


def find_spikes(tau: Array, not_repeated: Mask) -> list[Spikes]:
    """Return the spikes of torques (N, n); samples that repeat the one before do not count.

    The prominence of a sample is by how much it is above both neighbours, or below both. A spike
    has many times the prominence of noise, and neighbours that are alike.

    >>> x = np.sin(np.linspace(0.0, 6.0, 200))[:, None]
    >>> x[50] += 2.0
    >>> [each.rows.tolist() for each in find_spikes(x, np.full(200, True))]
    [[50]]
    """
    places = np.flatnonzero(not_repeated)
    if places.size < FEWEST_CHANGED:
        return []
    # Quantiles of as many samples as decide.
    some = slice(None, None, max(1, places.size // 20_000))
    found = []
    for k in range(tau.shape[1]):  # one by one: a long log leaves no room for all of them
        x = tau[:, k] if places.size == len(tau) else tau[places, k]
        steps = np.diff(x)
        sizes = np.abs(steps)
        prominence = np.minimum(sizes[1:], sizes[:-1])
        # Above both neighbours or below both: the steps have opposite signs.
        prominence *= steps[1:] * steps[:-1] < 0.0
        low, high = np.quantile(x[some], [0.005, 0.995])
        # Own choices, tested on 25 real logs: a spike has 15 times the prominence that noise
        # reaches, and a tenth of the range of the torque;
        if not prominence.max() > 0.1 * (high - low):
            continue
        usual = np.quantile(prominence[some], 0.9)
        rows = np.flatnonzero(prominence > max(15.0 * usual, 0.1 * (high - low)))
        above = prominence[rows]
        # its neighbours are alike, and the three steps before and after it smaller, as in ringing
        # they are not.
        lone = np.abs(steps[rows + 1] + steps[rows]) < 0.5 * above
        nearby = np.clip(rows[:, None] + NEIGHBOURS, 0, len(steps) - 1)
        lone &= above > 3.0 * np.max(sizes[nearby], axis=1)
        # More than a twentieth of the samples are no outliers.
        if 0 < np.count_nonzero(lone) <= 0.05 * len(prominence):
            found.append(Spikes(k, places[rows[lone] + 1], above[lone]))
    return found


def replace_spikes(recording: Recording) -> Recording:
    """Return the recording with the mean of their neighbours in place of torques that stand out."""
    if recording.has_computed_torque or recording.n_samples < FEWEST_CHANGED:
        return recording
    tau = np.array(recording.tau)
    found = find_spikes(tau, find_changed_rows(tau, recording.q))
    for spike in found:
        x = tau[:, spike.joint]
        # Interpolated over neighbours that stand out themselves.
        usual = np.setdiff1d(np.arange(len(x)), spike.rows)
        x[spike.rows] = np.interp(spike.rows, usual, x[usual])
    return replace(recording, tau=tau) if found else recording
