"""Whether the clock of a recording can be trusted, and whether every value is there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.experiment.quality.first_pass import Missing, Survey
from asbuilt.experiment.quality.smoothed_motion import GAP_STEPS
from asbuilt.findings import Finding, joined

_IRREGULAR = 0.05
"""Standard deviation of the steps, in steps, from which a clock is uneven."""
_SHORT_RUN = 20
"""Repeats of a sample beyond which the robot stands still, and the log is not to blame."""
_STALE = 0.2
"""Share of repeated samples from which it is said so."""
_SLOWEST, _FASTEST = 5.0, 1e5
"""No controller logs at a rate below the first or above the second [Hz]."""
_CLOCK_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units that clocks count in, in seconds."""


def clock_findings(recording: Survey) -> Iterator[Finding]:
    """Look for values that are no numbers or absurd, a clock in the wrong unit, times that repeat,
    run back or jump, an uneven clock, and samples that repeat the last one.
    """
    yield from _not_finite(recording)
    t = recording.t
    steps = np.diff(t)
    backward = np.flatnonzero(steps < 0)
    if backward.size:
        k = int(backward[0])
        yield Finding(
            "clock_backward",
            "error",
            f"time runs back {backward.size} times, first from {t[k]:.6g} s to {t[k + 1]:.6g} s at"
            f" sample {k + 2}",
            "Several logs may have been joined, or the clock was set while recording; split the"
            " file there and give the parts as separate recordings",
            time=float(t[k]),
        )
    repeated = np.flatnonzero(steps == 0)
    if repeated.size:
        k = int(repeated[0])
        yield Finding(
            "clock_repeated",
            "error" if repeated.size > 0.01 * t.size else "warning",
            f"{repeated.size} of {t.size} samples have the time stamp of the sample before, first"
            f" {t[k]:.6g} s at sample {k + 2}",
            "Remove the duplicates, or log time with more digits",
            time=float(t[k]),
        )
    forward = steps[np.isfinite(steps) & (steps > 0)]
    if not forward.size:
        return
    step = float(np.median(forward))
    yield from _wrong_unit(step)
    gaps = np.flatnonzero(steps > GAP_STEPS * step)
    if gaps.size:
        longest = int(gaps[np.argmax(steps[gaps])])
        yield Finding(
            "clock_gap",
            "warning",
            f"{gaps.size} gaps in the clock, the longest {steps[longest]:.4g} s after"
            f" {t[longest]:.6g} s where samples come every {step:.4g} s",
            "The recording is split there; find out why the logger lost samples if there are many",
            time=float(t[gaps[0]]),
        )
    usual = forward[forward <= GAP_STEPS * step]
    spread = float(np.std(usual) / step)
    if spread > _IRREGULAR:
        low, high = np.percentile(usual, [0.5, 99.5])
        yield Finding(
            "clock_irregular",
            "info",
            f"the clock is uneven: steps from {1e3 * low:.3g} ms to {1e3 * high:.3g} ms, median"
            f" {1e3 * step:.3g} ms",
            "The recording is resampled to an even clock; no action is needed",
        )
    yield from _stale(recording)


def _not_finite(recording: Survey) -> Iterator[Finding]:
    """Find values that are missing, infinite or absurd.

    Columns that lack the same rows are told of together.
    """
    bad_times = np.flatnonzero(~np.isfinite(recording.t))
    if bad_times.size:
        yield Finding(
            "not_finite",
            "error",
            f"{bad_times.size} of {recording.n_samples} time stamps are no numbers, first at sample"
            f" {bad_times[0] + 1}",
            "Repair or remove these rows",
        )
    alike: dict[bytes, list[Missing]] = {}
    for column in recording.missing:
        alike.setdefault(column.rows.tobytes(), []).append(column)
    for columns in alike.values():
        rows, value = columns[0].rows, columns[0].first
        kind = (
            "missing (NaN)"
            if np.isnan(value)
            else "infinite"
            if np.isinf(value)
            else f"{value:.3g}, which no robot logs,"
        )
        told = [
            f"the {what} of"
            f" {joined([recording.joint_names[column.joint] for column in columns if column.quantity == what])}"
            for what in dict.fromkeys(column.quantity for column in columns)
        ]
        yield Finding(
            "not_finite",
            "error",
            f"{rows.size} of {recording.n_samples} values of {' and '.join(told)} are no usable"
            f" numbers, the first {kind} at sample {rows[0] + 1}, t = {recording.t[rows[0]]:.6g} s",
            "Repair or remove these rows, or leave them out with time windows in a recording sheet",
            joint=recording.joint_names[columns[0].joint],
            time=float(recording.t[rows[0]]),
        )


def _wrong_unit(step: float) -> Iterator[Finding]:
    """Find a clock that counts in other units than seconds.

    No controller logs so slowly, or so fast.
    """
    if 1.0 / step > _FASTEST:
        yield Finding(
            "clock_unit",
            "error",
            f"samples come every {step:.3g} s, {1.0 / step:.3g} a second: the time stamps are not"
            " in the unit their name or the sheet says",
            'Write the unit in a recording sheet: units = { time = "s" }',
        )
    unit = next(
        (unit for unit, factor in _CLOCK_UNITS.items() if 20.0 <= 1.0 / (step * factor) <= 20e3),
        None,
    )
    if 1.0 / step < _SLOWEST and unit is not None:
        yield Finding(
            "clock_unit",
            "error",
            f"samples come every {step:.4g} s: the time stamps look like {unit}",
            f'Write the unit in a recording sheet: units = {{ time = "{unit}" }}',
        )


def _stale(recording: Survey) -> Iterator[Finding]:
    fresh = np.flatnonzero(recording.fresh)
    if fresh.size < 3:
        return
    runs = np.diff(np.append(fresh, recording.n_samples))
    brief = runs[runs <= _SHORT_RUN]
    if not brief.size or brief.sum() < 20:
        return
    repeats = 1.0 - brief.size / brief.sum()
    if repeats > _STALE:
        times = brief.sum() / brief.size
        yield Finding(
            "stale_samples",
            "warning",
            f"{100 * repeats:.0f} % of the samples repeat the one before in every joint: the log"
            f" runs at {recording.rate:.4g} Hz but values are fresh about every {times:.3g} samples"
            f" ({recording.rate / times:.3g} Hz)",
            "Log at the controller's rate, or keep the low-pass cutoff well below"
            f" {recording.rate / times / 2:.3g} Hz",
        )
