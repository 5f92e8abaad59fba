"""From the clock of the log to uniformly sampled runs without gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording

GAP = 4.5
"""A pause in the clock longer than this many sample periods is a gap."""
JITTER = 0.01
"""A clock whose steps all lie within this fraction of the sample period counts as uniform."""
SHORTEST_RUN = 8
"""Runs of fewer samples than this are not worth a spline and are dropped."""


@dataclass(frozen=True, eq=False)
class UniformRun:
    """One gapless run on a uniform clock: t (L,), q, tau and, where logged, qd (L, n).

    `tau` is the torque as recorded, at the instants t.
    """

    t: Array
    q: Array
    tau: Array
    qd: Array | None


def uniform_runs(
    recording: Recording, rate: float | None = None, max_gap: float | None = None
) -> tuple[list[UniformRun], float, tuple[str, ...]]:
    """Return the gapless runs of a recording on a uniform clock, their common rate [Hz] and a
    sentence for everything that was changed.

    Rows with NaN or infinities, rows whose time does not advance and rows that repeat the row
    before them to the last bit while the robot moves (a log polled faster than the controller
    writes) are dropped. A pause longer than `max_gap` [s] (by default 4.5 sample periods) ends a
    run; nothing is ever interpolated across it. An irregular clock, or one at another rate than
    asked for, is brought to a uniform one by cubic splines through the samples of the run (error
    (5/384) h^4 x'''' at step h: Hall and Meyer, Journal of Approximation Theory, 1976).

    Raises
    ------
    RecordingError
        If nothing is left, or the rate asked for is far above what was logged.
    """
    n = recording.n_samples
    kept = (
        np.isfinite(recording.t)
        & np.all(np.isfinite(recording.q), axis=1)
        & np.all(np.isfinite(recording.tau), axis=1)
    )
    notes: list[str] = []
    if not kept.all():
        notes.append(
            f"{n - int(kept.sum())} of {n} samples with NaN or infinite values were dropped"
        )
    latest = np.maximum.accumulate(np.where(kept, recording.t, -np.inf))
    advancing = kept & np.concatenate([[True], recording.t[1:] > latest[:-1]])
    if not np.array_equal(advancing, kept):
        notes.append(
            f"{int(kept.sum() - advancing.sum())} samples whose time does not advance were dropped"
        )
    index = np.flatnonzero(advancing)
    fresh = _fresh(recording, index)
    if fresh.size < index.size:
        notes.append(
            f"{index.size - fresh.size} samples that only repeat the one before (the log was polled"
            " faster than the controller writes) were dropped"
        )
    t = recording.t[fresh]
    if t.size < SHORTEST_RUN:
        raise RecordingError(
            f"{recording.source}: {t.size} usable samples of {n}; at least {SHORTEST_RUN} are"
            " needed"
        )
    steps = np.diff(t)
    period = float(np.median(steps))
    logged_rate = _logged_rate(t, period)
    if rate is not None and rate > 1.05 * logged_rate:
        raise RecordingError(
            f"{recording.source}: a rate of {rate:g} Hz was asked for but only {logged_rate:g} Hz"
            " were logged; drop the option or give a lower rate"
        )
    gap = GAP * period if max_gap is None else max_gap
    breaks = np.flatnonzero(steps > gap) + 1
    if breaks.size:
        notes.append(
            f"{breaks.size} gaps longer than {gap:g} s (the longest {steps.max():.3g} s) split the"
            f" recording into {breaks.size + 1} runs"
        )
    runs = [run for run in np.split(fresh, breaks) if run.size >= SHORTEST_RUN]
    if not runs:
        raise RecordingError(
            f"{recording.source}: no {SHORTEST_RUN} samples in a row without a gap of more than"
            f" {gap:g} s; check the clock"
        )
    target = logged_rate if rate is None else rate
    inside = np.delete(steps, breaks - 1)
    if np.all(np.abs(inside * target - 1.0) <= JITTER):
        return [_taken(recording, run, target) for run in runs], target, tuple(notes)
    clocks = [_clock(recording.t[run], recording.q[run]) for run in runs]
    ticks = sum(even for _, even in clocks)
    if rate is None and ticks == len(runs):
        target = _rounded(
            1.0 / float(np.median([np.median(np.diff(clock)) for clock, _ in clocks]))
        )
    if ticks:
        notes.append(
            "the time stamps jitter but the positions are smoother on an even clock, so the samples"
            " were taken as evenly spaced"
        )
    if ticks < len(runs) or rate is not None:
        notes.append(
            f"a clock with steps of {1e3 * inside.min():.3g} to {1e3 * inside.max():.3g} ms was"
            f" resampled to {target:g} Hz by cubic splines"
        )
    return (
        [
            _splined(recording, run, clock, target)
            for run, (clock, _) in zip(runs, clocks, strict=True)
        ],
        target,
        tuple(notes),
    )


def _fresh(recording: Recording, index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Drop exact repeats; those several times longer than usual are a robot at rest and stay."""
    rows = [recording.q[index], recording.tau[index]] + (
        [recording.qd[index]] if recording.qd is not None else []
    )
    changed = np.concatenate(
        [[True], np.any([np.any(np.diff(row, axis=0) != 0.0, axis=1) for row in rows], axis=0)]
    )
    if changed.all():
        return index
    starts = np.flatnonzero(changed)
    lengths = np.diff(np.append(starts, index.size))
    rest = np.repeat(lengths > GAP * np.median(lengths), lengths)
    fresh: NDArray[np.intp] = index[changed | rest]
    return fresh


def _logged_rate(t: Array, period: float) -> float:
    """Return the inverse of the mean step outside gaps, rounded where a whole number fits to a part
    in a thousand.
    """
    steps = np.diff(t)
    return _rounded(1.0 / float(np.mean(steps[steps <= GAP * period])))


def _rounded(rate: float) -> float:
    return float(round(rate)) if abs(rate - round(rate)) < 1e-3 * rate and rate > 20 else rate


def _clock(t: Array, q: Array) -> tuple[Array, bool]:
    """Return the instants of a run.

    An even clock fitted to the stamps where that makes the positions smoother, otherwise the
    stamps.

    A controller that samples evenly but is stamped by another process has stamps that jitter about
    its ticks; believing them would turn speed times jitter into position noise. Smoothness is the
    root mean square of the third difference on an even grid.
    """
    period = float(np.median(np.diff(t)))
    tick = _ticks(t, period)
    if tick is None:
        return t, False
    slope, start = np.polyfit(tick, t - t[0], 1)
    even = t[0] + start + slope * tick
    if np.max(np.abs(even - t)) > 0.6 * period:
        return t, False
    grid = np.arange(int(tick[-1]) + 1)
    on_even = CubicSpline(tick, q, axis=0)(grid)
    inside = t[0] + np.clip(start + slope * grid, 0.0, t[-1] - t[0])
    on_stamps = CubicSpline(t, q, axis=0)(inside)
    roughness = [
        np.sqrt(np.mean(np.diff(x[1:-1], n=3, axis=0) ** 2, axis=0)) for x in (on_even, on_stamps)
    ]
    return (
        (even, True)
        if np.median(roughness[0] / np.maximum(roughness[1], 1e-300)) < 1.0
        else (t, False)
    )


def _ticks(t: Array, period: float) -> Array | None:
    """Return the number of the clock tick (L,) each stamp belongs to, or None where the stamps
    follow no clock of this period.

    The phase of the stamps against the period is averaged on the circle over stretches of a few
    hundred stamps, so that a late stamp is not taken for a lost sample, and unwrapped from stretch
    to stretch, so that the period need not be exact.
    """
    turns = (t - t[0]) / period
    stretches = np.array_split(np.arange(t.size), max(1, t.size // 256))
    means = np.array([np.mean(np.exp(2j * np.pi * turns[stretch])) for stretch in stretches])
    if np.any(np.abs(means) < 0.3):
        return None
    centre = np.array([stretch.mean() for stretch in stretches])
    phase = np.interp(np.arange(t.size), centre, np.unwrap(np.angle(means)) / (2.0 * np.pi))
    tick = np.rint(turns - phase)
    return tick - tick[0] if np.all(np.diff(tick) >= 1) else None


def _taken(recording: Recording, run: NDArray[np.intp], rate: float) -> UniformRun:
    t0 = recording.t[run[0]]
    even = t0 + np.arange(run.size) / rate
    t = even if np.max(np.abs(even - recording.t[run])) < 0.5 / rate else recording.t[run]
    qd = None if recording.qd is None else recording.qd[run]
    return UniformRun(
        t,
        recording.q[run],
        recording.tau[run],
        qd if qd is not None and np.all(np.isfinite(qd)) else None,
    )


def _splined(recording: Recording, run: NDArray[np.intp], clock: Array, rate: float) -> UniformRun:
    t = clock[0] + np.arange(int(np.floor((clock[-1] - clock[0]) * rate + 1e-6)) + 1) / rate
    inside = np.minimum(t, clock[-1])
    qd = None if recording.qd is None else recording.qd[run]

    def resampled(x: Array) -> Array:
        return np.ascontiguousarray(CubicSpline(clock, x, axis=0)(inside))

    return UniformRun(
        t,
        resampled(recording.q[run]),
        resampled(recording.tau[run]),
        resampled(qd) if qd is not None and np.all(np.isfinite(qd)) else None,
    )
