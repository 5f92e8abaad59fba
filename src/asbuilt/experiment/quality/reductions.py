"""What checks reduce a recording to: running statistics of all samples, smoothed segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
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
        # NaN would win every minimum, so that it is masked.
        finite = np.isfinite(values)
        return Extremes(
            self.count + finite.sum(axis=0),
            np.minimum(self.low, values.min(axis=0, where=finite, initial=np.inf)),
            np.maximum(self.high, values.max(axis=0, where=finite, initial=-np.inf)),
        )


@dataclass(frozen=True, eq=False)
class Exceedance:
    """Hold for each column how many samples exceed a bound, and amount, value and row of the worst.

    All are (n,).
    """

    count: Indices = field(default_factory=ZERO)
    amount: Array = field(default_factory=LOWEST)
    value: Array = field(default_factory=UNKNOWN)
    row: Indices = field(default_factory=ZERO)

    def with_more(self, amount: Array, exceeds: Mask, value: Array, rows: Indices) -> Exceedance:
        """Include amounts (may be NaN), which exceed, values, all (N, n), and rows (N,)."""
        if not len(rows):
            return self
        # A joint whose amounts are all NaN never exceeds.
        amount = np.where(np.isnan(amount), -np.inf, amount)
        place = np.argmax(amount, axis=0)
        columns = np.arange(amount.shape[1])
        worst = amount[place, columns]
        # Strictly: of equal ones the first stays.
        worse = worst > self.amount
        return Exceedance(
            self.count + exceeds.sum(axis=0),
            np.where(worse, worst, self.amount),
            np.where(worse, value[place, columns], self.value),
            np.where(worse, rows[place], self.row),
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
        complete = q[np.all(np.isfinite(q), axis=1)]
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


def choose_segments(t: Array, valid: Mask) -> tuple[list[Indices], float, int]:
    """Return rows of a dozen segments at most between gaps, the clock's step, and the window.

    There is no segment where none is long enough for the window, by which it is smoothed.
    """
    rows = np.flatnonzero(valid)
    # Times that repeat or go back: each time once, in order.
    t, first = np.unique(t[rows], return_index=True)
    rows = rows[first]
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
        # Evenly spread over the log, its beginning and end included.
    ]
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


def normalise_columns(x: Array) -> Array:
    """Return columns without their means, of unit length; zero where they are constant.

    Products of such columns are their correlations.
    """
    x = x - x.mean(axis=0)
    length = np.linalg.norm(x, axis=0)
    # A constant column becomes zero: it correlates with nothing.
    return np.asarray(x / np.where(length > 0.0, length, np.inf))
