"""Checks of a recording's clock, and of values that are missing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.experiment.quality.passes import FirstPass, Missing
from asbuilt.experiment.quality.reductions import GAP_STEPS, MOST_REPEATS
from asbuilt.findings import Cure, Finding, join_names

_CLOCK_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}

FEW_GAPS = 5
FEW_LOST = 0.01
"""Number of gaps, and their share of the time, up to which they are worth no action: segments are
then long, and nearly all samples used."""


def check_clock(statistics: FirstPass) -> Iterator[Finding]:
    """Find missing values, wrong units of time, time stamps that repeat, decrease or jump."""
    yield from _find_not_finite(statistics)
    clock = statistics.clock
    backward = clock.backward
    if backward.count:
        yield Finding(
            "clock_backward",
            "error",
            f"time decreases {backward.count} times, first from {backward.before:.6g} s to"
            f" {backward.after:.6g} s at sample {backward.row + 2}",
            Cure("split the file there and give the parts as separate recordings"),
            time=backward.before,
        )
    repeated = clock.repeated
    if repeated.count:
        yield Finding(
            "clock_repeated",
            # One duplicate in a hundred is dropped when the log is resampled.
            "error" if repeated.count > 0.01 * clock.n_samples else "warning",
            f"{repeated.count} of {clock.n_samples} samples have the time stamp of the sample"
            f" before, first {repeated.before:.6g} s at sample {repeated.row + 2}",
            Cure("remove the duplicates, or log time with more digits"),
            time=repeated.before,
        )
    if not clock.forward.size:
        return
    step = clock.step
    yield from _find_wrong_unit(step)
    # A gap splits the log, so that no filter runs across it.
    before, gaps = clock.gaps
    if gaps.size:
        longest = int(np.argmax(gaps))
        # A few lost samples are nobody's worry: the recording is split there.
        few = gaps.size <= FEW_GAPS and gaps.sum() < FEW_LOST * statistics.duration
        yield Finding(
            "clock_gap",
            "info" if few else "warning",
            f"the clock has {gaps.size} gap{'s' * (gaps.size > 1)}, the longest"
            f" {gaps[longest]:.4g} s after {before[longest]:.6g} s; the usual step is {step:.4g} s",
            Cure("find out why samples are lost if there are many; the recording is split there"),
            time=float(before[0]),
        )
    usual = clock.forward[clock.forward <= GAP_STEPS * step]
    # Standard deviation of the steps, in steps, from which a clock is uneven.
    # Percentiles, as single late samples say nothing of the clock.
    if float(np.std(usual / step)) > 0.05:
        low, high = np.percentile(usual, [0.5, 99.5])
        yield Finding(
            "clock_irregular",
            "info",
            f"the clock is uneven: steps from {1e3 * low:.3g} ms to {1e3 * high:.3g} ms, median"
            f" {1e3 * step:.3g} ms",
            Cure("no action is needed: the recording is resampled to a uniform clock"),
        )
    yield from _find_stale(statistics)


def _find_not_finite(statistics: FirstPass) -> Iterator[Finding]:
    """Find values that are missing, infinite or absurd, once for columns with the same rows."""
    clock = statistics.clock
    if clock.n_unknown:
        yield Finding(
            "not_finite",
            "error",
            f"{clock.n_unknown} of {statistics.n_samples} time stamps are not numbers, first at"
            f" sample {clock.unknown_row + 1}",
            Cure("repair or remove these rows"),
        )
    together: dict[bytes, list[Missing]] = {}
    # Columns that miss the same rows have one cause, and one finding.
    for column in statistics.missing:
        together.setdefault(column.rows.tobytes(), []).append(column)
    names = statistics.first.joint_names
    for columns in together.values():
        rows = columns[0].rows
        value = columns[0].first
        kind = (
            "missing (NaN)"
            if np.isnan(value)
            else "infinite"
            if np.isinf(value)
            else f"{value:.3g}, beyond what a robot logs,"
        )
        listed = [
            f"the {what} of {join_names([names[c.joint] for c in columns if c.quantity == what])}"
            for what in dict.fromkeys(column.quantity for column in columns)
        ]
        yield Finding(
            "not_finite",
            "error",
            f"{rows.size} of {statistics.n_samples} values of {' and '.join(listed)} are not usable"
            f" numbers, the first {kind} at sample {rows[0] + 1}, t = {columns[0].time:.6g} s",
            Cure("repair or remove these rows, or exclude them by [[windows]] in a sheet"),
            joint=names[columns[0].joint],
            time=columns[0].time,
        )


def _find_wrong_unit(step: float) -> Iterator[Finding]:
    """Find a clock with a rate that no controller has."""
    rate = 1.0 / step
    # Controllers on the market log at 5 Hz to 100 kHz.
    if rate > 1e5:
        yield Finding(
            "clock_unit",
            "error",
            f"the sampling rate is {rate:.3g} Hz ({step:.3g} s a sample): the unit of the time"
            " stamps is not the one that their name or the sheet gives",
            Cure('write the unit in a recording sheet: units = { time = "s" }'),
        )
    # Even as nanoseconds no controller is this slow.
    if rate < min(_CLOCK_UNITS.values()):
        yield Finding(
            "clock_unit",
            "error",
            f"the sampling rate is {rate:.3g} Hz ({step:.3g} s a sample): the time stamps are in no"
            " known unit",
            Cure("write true times, or a column of them, and their unit in a recording sheet"),
        )
    # A unit under which the rate is a usual one.
    unit = next((u for u, factor in _CLOCK_UNITS.items() if 20.0 <= rate / factor <= 20e3), None)
    if rate < 5.0 and unit is not None:
        yield Finding(
            "clock_unit",
            "error",
            f"the sampling rate is {rate:.3g} Hz ({step:.4g} s a sample): the time stamps look"
            f" like {unit}",
            Cure(
                f'write the unit in a recording sheet: units = {{ time = "{unit}" }}',
                sheet={"units": {"time": unit}},
            ),
        )


def _find_stale(statistics: FirstPass) -> Iterator[Finding]:
    repeats = statistics.repeats
    if repeats.n_changed < 3 or repeats.brief < MOST_REPEATS:
        return
    # A value changes once in so many samples.
    times = repeats.brief / repeats.n_brief
    share = 1.0 - repeats.n_brief / repeats.brief
    rate = statistics.rate / times
    if share > 0.2:
        yield Finding(
            "stale_samples",
            "warning",
            f"{100 * share:.0f} % of the samples repeat the one before in every joint: values"
            f" change about every {times:.3g} samples ({rate:.3g} Hz), the log has"
            f" {statistics.rate:.4g} Hz",
            Cure(
                "log at the controller's rate, or keep the low-pass cutoff well below"
                f" {rate / 2:.3g} Hz"
            ),
        )
