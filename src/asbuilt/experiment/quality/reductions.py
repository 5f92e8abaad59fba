"""What checks reduce a recording to: running statistics of all samples, smoothed segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import factorial

import numpy as np
from scipy.linalg import lstsq

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.parallel_filter import filter_rows

ZERO, UNKNOWN, HIGHEST, LOWEST = (
    partial(np.array, value) for value in (0, np.nan, np.inf, -np.inf)
)
"""Values before any sample, the same for all columns."""


@dataclass(frozen=True, eq=False)
class Extremes:
    """Hold count, lowest and highest finite value of each column, all (n,); infinite if none."""

    count: Indices = field(default_factory=ZERO)
    low: Array = field(default_factory=HIGHEST)
    high: Array = field(default_factory=LOWEST)

    def with_more(self, values: Array) -> Extremes:
        """Include further values (N, n); those that are not finite do not count."""
        if not values.size:
            return self
        low = values.min(axis=0)
        high = values.max(axis=0)
        if np.isfinite(low).all() and np.isfinite(high).all():
            # The usual case, without a mask of all values.
            return Extremes(
                self.count + np.full(low.shape, len(values)),
                np.minimum(self.low, low),
                np.maximum(self.high, high),
            )
        # NaN would win every minimum, so that it is masked.
        finite = np.isfinite(values)
        return Extremes(
            self.count + finite.sum(axis=0),
            np.minimum(self.low, values.min(axis=0, where=finite, initial=np.inf)),
            np.maximum(self.high, values.max(axis=0, where=finite, initial=-np.inf)),
        )

    @property
    def furthest(self) -> Array:
        """Largest size of each column, (n,); NaN where there is no value."""
        return np.where(self.count > 0, np.maximum(np.abs(self.low), np.abs(self.high)), np.nan)


@dataclass(frozen=True, eq=False)
class Exceedance:
    """Hold for each column how many samples exceed a bound, and the worst of them.

    Of that its amount, value and time [s]; all are (n,).
    """

    count: Indices = field(default_factory=ZERO)
    amount: Array = field(default_factory=LOWEST)
    value: Array = field(default_factory=UNKNOWN)
    time: Array = field(default_factory=UNKNOWN)

    def with_more(self, amount: Array, exceeds: Mask, value: Array, t: Array) -> Exceedance:
        """Include amounts (may be NaN), which exceed, values, all (N, n), and times (N,)."""
        if not exceeds.any():
            # Counts have the shape of the columns from the first samples on.
            return replace(self, count=self.count + np.zeros(exceeds.shape[1], dtype=np.int64))
        amount = np.where(exceeds, amount, -np.inf)
        place = np.argmax(amount, axis=0)
        columns = np.arange(amount.shape[1])
        worst = amount[place, columns]
        # Strictly: of equal ones the first stays.
        worse = worst > self.amount
        return Exceedance(
            self.count + exceeds.sum(axis=0),
            np.where(worse, worst, self.amount),
            np.where(worse, value[place, columns], self.value),
            np.where(worse, t[place], self.time),
        )


@dataclass(frozen=True, eq=False)
class PositionMoments:
    """Hold first and second moments of complete samples of positions, about the first of them.

    `about` and `total` are (n,), `products` (n, n).
    """

    n_samples: int = 0
    about: Array = field(default_factory=ZERO)
    total: Array = field(default_factory=ZERO)
    products: Array = field(default_factory=ZERO)

    def with_more(self, q: Array) -> PositionMoments:
        """Include further positions (N, n); rows with a value that is not finite do not count."""
        finite = np.isfinite(q)
        complete = q if finite.all() else q[np.all(finite, axis=1)]
        # About the first sample: joints that hardly move keep their digits.
        about = self.about if self.n_samples or not len(complete) else complete[0]
        apart = complete - about
        return PositionMoments(
            self.n_samples + len(complete),
            about,
            self.total + apart.sum(axis=0),
            self.products + apart.T @ apart,
        )

    @property
    def moving(self) -> list[int]:
        """Joints whose position varies."""
        return [int(k) for k in np.flatnonzero(np.diag(self.products) > 0.0)]

    def correlations(self, joints: list[int]) -> Array:
        """Return the correlation coefficients of the positions of joints that move."""
        mean = self.total[joints] / self.n_samples
        # Mean of squares less the square of the mean, in one pass.
        covariance = self.products[np.ix_(joints, joints)] / self.n_samples - np.outer(mean, mean)
        size = np.sqrt(np.diag(covariance))
        # Rounding can leave a correlation just above one.
        return np.asarray(np.clip(covariance / np.outer(size, size), -1.0, 1.0))


GAP_STEPS = 5.0
"""Multiple of the median time step from which a step is a gap."""
CANDIDATE_STEPS = 2.5
"""Multiple of the median step so far from which a step may turn out to be a gap."""
KEPT_SAMPLES = 1_000_000
"""Samples whose times are kept: beyond them those of every second chunk are, every fourth, ..."""
MOST_REPEATS = 20
"""A sample repeated more often is a robot at rest, for which the log is not to blame."""


@dataclass(frozen=True, eq=False)
class Steps:
    """Count steps of a clock of one kind, and hold row and times [s] of the first of them."""

    count: int = 0
    row: int = -1
    before: float = np.nan
    after: float = np.nan

    def with_more(self, which: Mask, t: Array, begin: int) -> Steps:
        """Include the steps between times (N,), of which the first is of row `begin`."""
        if not which.any():
            return self
        if self.count:
            return replace(self, count=self.count + int(which.sum()))
        k = int(np.argmax(which))
        return Steps(int(which.sum()), begin + k, float(t[k]), float(t[k + 1]))


@dataclass(frozen=True, eq=False)
class Chunk:
    """Hold times (N,) [s] and validity of consecutive samples, the first of which is of a row."""

    begin: int
    t: Array
    valid: Mask


@dataclass(frozen=True, eq=False)
class Clock:
    """Hold what is asked of the times of all samples, and the times of some.

    Parameters
    ----------
    n_samples, n_chunks
        Numbers so far.
    n_unknown, unknown_row
        Number of times that are not finite, and the row of the first of them.
    first, last, earliest, latest
        Times [s] of the first and the last sample, and the extremes of the finite ones.
    backward, repeated
        Steps below and of zero.
    usual
        The smallest median step of a chunk [s].
    long
        Times before steps that may be gaps, and these steps [s], shape (N, 2).
    stride, kept, newest
        Chunks of which times are kept: every so manieth, and the newest.
    """

    n_samples: int = 0
    n_chunks: int = 0
    n_unknown: int = 0
    unknown_row: int = -1
    first: float = np.nan
    last: float = np.nan
    earliest: float = np.inf
    latest: float = -np.inf
    backward: Steps = field(default_factory=Steps)
    repeated: Steps = field(default_factory=Steps)
    usual: float = np.inf
    long: tuple[Array, ...] = ()
    stride: int = 1
    kept: tuple[Chunk, ...] = ()
    newest: Chunk | None = None

    def with_more(self, t: Array, valid: Mask) -> Clock:
        """Include the times (N,) of further samples [s] and whether they are valid (N,)."""
        if not t.size:
            return self
        joined = np.concatenate([[self.last], t]) if self.n_samples else t
        begin = self.n_samples - 1 if self.n_samples else 0
        steps = np.diff(joined)
        forward = steps[np.isfinite(steps) & (steps > 0.0)]
        usual = min(self.usual, float(np.median(forward)) if forward.size else np.inf)
        long = steps > CANDIDATE_STEPS * usual
        finite = np.isfinite(t)
        n_unknown = int(t.size - finite.sum())
        unknown_row = self.unknown_row
        if n_unknown and not self.n_unknown:
            unknown_row = self.n_samples + int(np.argmin(finite))
        return replace(
            self._with_chunk(Chunk(self.n_samples, np.array(t), valid)),
            n_samples=self.n_samples + t.size,
            n_chunks=self.n_chunks + 1,
            n_unknown=self.n_unknown + n_unknown,
            unknown_row=unknown_row,
            first=self.first if self.n_samples else float(t[0]),
            last=float(t[-1]),
            earliest=min(self.earliest, float(t.min(where=finite, initial=np.inf))),
            latest=max(self.latest, float(t.max(where=finite, initial=-np.inf))),
            backward=self.backward.with_more(steps < 0.0, joined, begin),
            repeated=self.repeated.with_more(steps == 0.0, joined, begin),
            usual=usual,
            long=(*self.long, np.stack([joined[:-1][long], steps[long]], axis=1))
            if long.any()
            else self.long,
        )

    def _with_chunk(self, chunk: Chunk) -> Clock:
        """Return the same with the times of one more chunk, and those of fewer before."""
        kept = self.kept
        if self.newest is not None and (self.n_chunks - 1) % self.stride == 0:
            kept = (*kept, self.newest)
        stride = self.stride
        if sum(each.t.size for each in kept) > KEPT_SAMPLES:
            kept = kept[::2]
            stride *= 2
        return replace(self, kept=kept, stride=stride, newest=chunk)

    @cached_property
    def t(self) -> Array:
        """Times that are kept [s], shape (K,)."""
        return np.concatenate([chunk.t for chunk in self._chunks])

    @cached_property
    def rows(self) -> Indices:
        """Their rows, shape (K,)."""
        return np.concatenate(
            [np.arange(chunk.begin, chunk.begin + chunk.t.size) for chunk in self._chunks]
        )

    @cached_property
    def valid(self) -> Mask:
        """Whether the samples at these times are valid, shape (K,)."""
        return np.concatenate([chunk.valid for chunk in self._chunks])

    @cached_property
    def forward(self) -> Array:
        """Positive steps between samples of consecutive rows that are kept [s]."""
        steps = np.diff(self.t)[np.diff(self.rows) == 1]
        return np.asarray(steps[np.isfinite(steps) & (steps > 0.0)])

    @cached_property
    def step(self) -> float:
        """Median positive step [s]; NaN if there is none."""
        return float(np.median(self.forward)) if self.forward.size else np.nan

    @property
    def gaps(self) -> tuple[Array, Array]:
        """Times before the gaps and their lengths [s], each (n_gaps,)."""
        if not self.long:
            return np.zeros(0), np.zeros(0)
        t, lengths = np.concatenate(self.long).T
        gaps = lengths > GAP_STEPS * self.step
        return t[gaps], lengths[gaps]

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]; NaN if there is none."""
        return self.latest - self.earliest if self.latest >= self.earliest else np.nan

    @property
    def _chunks(self) -> tuple[Chunk, ...]:
        return self.kept if self.newest is None else (*self.kept, self.newest)


@dataclass(frozen=True, eq=False)
class Repeats:
    """Count samples that differ from the one before, and how often a value stays for a while.

    `n_brief` values stay for at most `MOST_REPEATS` samples, `brief` samples together.
    """

    n_changed: int = 0
    n_brief: int = 0
    brief: int = 0
    last: int = -1

    def with_more(self, changed: Mask, begin: int) -> Repeats:
        """Include samples of which some differ from the one before (N,), from row `begin` on."""
        rows = begin + np.flatnonzero(changed)
        if not rows.size:
            return self
        more = self._with_lengths(np.diff(rows if self.last < 0 else np.append(self.last, rows)))
        return replace(more, n_changed=self.n_changed + rows.size, last=int(rows[-1]))

    def ended(self, n_samples: int) -> Repeats:
        """Return the same after the last of so many samples."""
        return self if self.last < 0 else self._with_lengths(np.array([n_samples - self.last]))

    def _with_lengths(self, lengths: Indices) -> Repeats:
        brief = lengths[lengths <= MOST_REPEATS]
        return replace(self, n_brief=self.n_brief + brief.size, brief=self.brief + int(brief.sum()))


_SEGMENT_SAMPLES = 4000
_MOST_SEGMENTS = 12
"""Samples per segment and number of segments; more do not change a finding."""


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """Hold uniformly sampled segments of a recording, one after another, at `rate` [Hz].

    `q`, `qd`, `qdd`, `tau` and, if velocities were logged, `logged_qd` are (N, n).
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    logged_qd: Array | None
    rate: float

    @property
    def n_samples(self) -> int:
        """Number of samples in all segments."""
        return int(self.q.shape[0])

    def thinned(self, most: int) -> Indices:
        """Return the indices of about `most` samples at most, evenly spread."""
        return np.arange(0, self.n_samples, max(1, self.n_samples // most), dtype=np.int64)


def choose_segments(clock: Clock) -> tuple[list[Indices], float, int]:
    """Return rows of a dozen segments at most between gaps, the clock's step, and the window.

    There is no segment where none is long enough for the window, by which it is smoothed. Between
    chunks whose times are not kept there is a gap.
    """
    # Times that repeat or go back: each time once, in order.
    t, first = np.unique(clock.t[clock.valid], return_index=True)
    rows = clock.rows[clock.valid][first]
    if t.size < 20:
        return [], np.nan, 0
    steps = np.diff(t)
    step = float(np.median(steps))
    # 0.15: width of the smoothing [s].
    # Odd, so that the window has a middle.
    window = max(5, int(0.15 / step) | 1)
    breaks = np.flatnonzero(steps > GAP_STEPS * step) + 1
    bounds = [
        (a, b)
        for start, stop in zip([0, *breaks], [*breaks, t.size], strict=True)
        for a in range(start, stop, _SEGMENT_SAMPLES)
        for b in [min(a + _SEGMENT_SAMPLES, stop)]
        if b - a > 2 * window
    ]
    # Evenly spread over the log, its beginning and end included.
    chosen = np.linspace(0, len(bounds) - 1, min(len(bounds), _MOST_SEGMENTS)).astype(int)
    return [rows[slice(*bounds[k])] for k in chosen], step, window


def smooth_motion(logged: Sequence[Recording], step: float, window: int) -> SmoothedMotion:
    """Smooth positions and torques alike by local cubics over 0.15 s (Savitzky and Golay, 1964).

    `logged` are the samples of each segment. Derivatives are summed by parts, over steps in place
    of values, so that a joint at rest has a velocity of exactly 0.
    """
    value, *slopes = _derive_cubic_taps(window, step)
    # By parts: constant positions have steps of exactly zero.
    of_steps = [-np.cumsum(taps)[:-1] for taps in slopes]
    smooth: list[list[Array]] = []
    for part in logged:
        columns = [part.q, part.tau] + ([part.qd] if part.qd is not None else [])
        # The median step, so that one set of taps serves all segments.
        even = np.arange(part.t[0], part.t[-1], step)
        q, *rest = [_resample(even, part.t, values) for values in columns]
        steps = np.diff(q, axis=1)
        derivatives = [filter_rows(q, value), *(filter_rows(steps, step) for step in of_steps)]
        others = [filter_rows(values, value) for values in rest]
        smooth.append([values.T for values in (*derivatives, *others)])
    q, qd, qdd, tau, *measured = [np.concatenate(parts) for parts in zip(*smooth, strict=True)]
    return SmoothedMotion(q, qd, qdd, tau, measured[0] if measured else None, 1.0 / step)


def _derive_cubic_taps(window: int, step: float) -> list[Array]:
    """Return the taps of value, slope and curvature of the cubic that fits a window best.

    As `scipy.signal.savgol_coeffs`, whose package takes long to import.
    """
    powers = np.arange(window, dtype=np.float64) - window // 2
    A = powers ** np.arange(4.0)[:, None]
    # k! / step^k turns a coefficient of the cubic into a derivative.
    return [lstsq(A, np.eye(4)[k] * factorial(k) / step**k)[0] for k in range(3)]


def _resample(even: Array, t: Array, values: Array) -> Array:
    """Return the columns of values (L, n) at the times `even` (N,) as rows (n, N)."""
    return np.array([np.interp(even, t, column) for column in np.ascontiguousarray(values.T)])


def find_swapped_columns(correlation: Array, other: float, own: float) -> list[tuple[int, int]]:
    """Return rows that correlate with the column of another, and not with their own, with these.

    More than `other` with the other's, and less than `own`, which is smaller, with their own.
    """
    # Rows that move in step correlate with all columns: their own correlation must be poor.
    if np.all(np.diag(correlation) >= own):
        return []
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - light start

    # One assignment of all columns: pairs alone would miss a cycle.
    return [
        (int(row), int(column))
        for row, column in zip(*linear_sum_assignment(-correlation), strict=True)
        if correlation[row, column] > other and correlation[row, row] < own
    ]


def normalise_columns(x: Array) -> Array:
    """Return columns without their means, of unit length; zero where they are constant.

    Products of such columns are their correlations.
    """
    x = x - x.mean(axis=0)
    length = np.linalg.norm(x, axis=0)
    # A constant column becomes zero: it correlates with nothing.
    return np.asarray(x / np.where(length > 0.0, length, np.inf))
