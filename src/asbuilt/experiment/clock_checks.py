"""Whether the clock of a recording can be trusted, and whether every value is there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from asbuilt.experiment.finding import Finding
from asbuilt.experiment.recording import Array, Recording
from asbuilt.experiment.smoothed_motion import GAP_STEPS

_IRREGULAR = 0.05
_SHORT_RUN = 20
_STALE = 0.2


def clock_findings(recording: Recording) -> Iterator[Finding]:
    """Look for values that are no numbers, times that repeat, run back or jump, an uneven clock, and samples that repeat the last one."""
    yield from _not_finite(recording)
    t = recording.t
    steps = np.diff(t)
    backward = np.flatnonzero(steps < 0)
    if backward.size:
        k = int(backward[0])
        yield Finding(
            "clock-backward",
            "error",
            f"time runs back {backward.size} times, first from {t[k]:.6g} s to {t[k + 1]:.6g} s at sample {k + 2}",
            "Several logs may have been joined, or the clock was set while recording; split the file there and give the parts as separate recordings",
            time=float(t[k]),
        )
    repeated = np.flatnonzero(steps == 0)
    if repeated.size:
        k = int(repeated[0])
        yield Finding(
            "clock-repeated",
            "error" if repeated.size > 0.01 * t.size else "warning",
            f"{repeated.size} of {t.size} samples have the time stamp of the sample before, first {t[k]:.6g} s at sample {k + 2}",
            "Remove the duplicates, or log time with more digits",
            time=float(t[k]),
        )
    forward = steps[np.isfinite(steps) & (steps > 0)]
    if not forward.size:
        return
    step = float(np.median(forward))
    gaps = np.flatnonzero(steps > GAP_STEPS * step)
    if gaps.size:
        longest = int(gaps[np.argmax(steps[gaps])])
        yield Finding(
            "clock-gap",
            "warning",
            f"{gaps.size} gaps in the clock, the longest {steps[longest]:.4g} s after {t[longest]:.6g} s where samples come every {step:.4g} s",
            "The recording is split there; find out why the logger lost samples if there are many",
            time=float(t[gaps[0]]),
        )
    usual = forward[forward <= GAP_STEPS * step]
    spread = float(np.std(usual) / step)
    if spread > _IRREGULAR:
        low, high = np.percentile(usual, [0.5, 99.5])
        yield Finding(
            "clock-irregular",
            "info",
            f"the clock is uneven: steps from {1e3 * low:.3g} ms to {1e3 * high:.3g} ms, median {1e3 * step:.3g} ms",
            "The recording is resampled to an even clock; no action is needed",
        )
    yield from _stale(recording)


def fresh_samples(recording: Recording) -> NDArray[np.bool_]:
    """Return which samples differ from the one before in position or torque."""
    changed = np.any(np.diff(recording.q, axis=0) != 0, axis=1) | np.any(np.diff(recording.tau, axis=0) != 0, axis=1)
    return np.concatenate([[True], changed])


def _not_finite(recording: Recording) -> Iterator[Finding]:
    columns: list[tuple[str, Array]] = [("position", recording.q), ("torque", recording.tau)]
    columns += [("velocity", recording.qd)] if recording.qd is not None else []
    columns += [("acceleration", recording.qdd)] if recording.qdd is not None else []
    bad_times = np.flatnonzero(~np.isfinite(recording.t))
    if bad_times.size:
        yield Finding(
            "not-finite",
            "error",
            f"{bad_times.size} of {recording.n_samples} time stamps are no numbers, first at sample {bad_times[0] + 1}",
            "Repair or remove these rows",
        )
    for what, values in columns:
        bad = ~np.isfinite(values)
        if not bad.any():
            continue
        for k in np.flatnonzero(bad.any(axis=0)):
            first = int(np.flatnonzero(bad[:, k])[0])
            kind = "infinite" if np.isinf(values[first, k]) else "missing (NaN)"
            yield Finding(
                "not-finite",
                "error",
                f"{int(bad[:, k].sum())} of {recording.n_samples} values of the {what} of {recording.joint_names[k]} are no numbers, "
                f"the first {kind} at sample {first + 1}, t = {recording.t[first]:.6g} s",
                "Repair or remove these rows, or leave them out with time windows in a recording sheet",
                joint=recording.joint_names[k],
                time=float(recording.t[first]),
            )


def _stale(recording: Recording) -> Iterator[Finding]:
    fresh = np.flatnonzero(fresh_samples(recording))
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
            "stale-samples",
            "warning",
            f"{100 * repeats:.0f} % of the samples repeat the one before in every joint: the log runs at {recording.rate:.4g} Hz but values are fresh "
            f"about every {times:.3g} samples ({recording.rate / times:.3g} Hz)",
            f"Log at the controller's rate, or keep the low-pass cutoff well below {recording.rate / times / 2:.3g} Hz",
        )
