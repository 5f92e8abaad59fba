"""Checks of the torque signals: missing, saturated, filtered or logged without a sign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.command.magnitude import (
    choose_sign_cure,
    describe_laws,
    fit_magnitude_laws,
    is_magnitude,
)
from asbuilt.experiment.quality.motion_checks import doubt_limits
from asbuilt.experiment.quality.passes import FirstPass, Missing, SecondPass
from asbuilt.experiment.quality.reductions import GAP_STEPS, MOST_REPEATS, Extremes
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.band_choice import power_density
from asbuilt.findings import Cure, Finding, join_names

EXCEEDED = 1.2
"""Multiple of a torque limit that no drive gives: sensors and filters overshoot by less."""


def check_channels(model: RobotModel, statistics: FirstPass) -> Iterator[Finding]:
    """Name joints without a usable torque channel, unless there is none at all."""
    if not statistics.first.has_torque.any():
        return
    for k in np.flatnonzero(~statistics.first.has_torque).tolist():
        joint = model.joints[k]
        value = statistics.first.tau[0, k]
        ranges = statistics.position_range
        what = (
            f"is not logged in any of {statistics.n_samples} samples"
            if np.isnan(value)
            else f"is {value:.4g} {joint.torque_unit} in all {statistics.n_samples} samples, while"
            f" the joint moves by {ranges.high[k] - ranges.low[k]:.3g} {joint.unit}"
        )
        yield Finding(
            "joint_without_torque",
            "warning",
            f"the torque of {joint.name} {what}; it is not used, and the friction of {joint.name}"
            " and what else this torque alone determines stay at CAD",
            Cure("log it, or name its column in a recording sheet: [columns] torque = [...]"),
            joint=joint.name,
            # The whole torque of this joint is lost: it ranks first.
            torque=1.0,
        )


def check_saturation(
    model: RobotModel, statistics: FirstPass, closer: SecondPass
) -> Iterator[Finding]:
    """Find torques that stay at an extreme value or reach the joint's torque limit.

    An extreme of zero is none: magnitudes rest there.
    """
    n_changed = statistics.repeats.n_changed
    # Currents have no limit in the description's unit.
    limited = statistics.first.torque_source != "current"
    doubted = _doubt_torque_limits(model, statistics) if limited else None
    if doubted is not None:
        yield doubted
    for k, joint in enumerate(model.joints):
        for plateau in closer.plateaus[k]:
            flat = plateau.places.size
            longest, start = _find_longest_block(plateau.places)
            # How often another value near the extreme occurs: a coarse torque repeats every value.
            usual = (plateau.n_near - flat) / max(1, plateau.n_values - 1)
            # 5: consecutive samples at an extreme from which a torque may be saturated.
            # Eight times as often as its neighbours: no accident of the steps.
            if plateau.extreme != 0.0 and longest >= 5 and flat > 8 * max(usual, 1.0):
                yield Finding(
                    "saturation",
                    "warning",
                    f"the torque of {joint.name} is saturated at {plateau.extreme:.5g} N m in"
                    f" {flat} of {n_changed} samples, up to {longest} in a row",
                    Cure(
                        "exclude these segments by [[windows]] in a recording sheet, or record a"
                        " gentler motion"
                    ),
                    joint=joint.name,
                    time=float(plateau.times[start]),
                )
        limit = joint.limits.torque
        over = int(statistics.saturated.count[k])
        believed = limited and doubted is None and 0.0 < limit < np.inf
        # From half of the samples on the limit itself is doubted elsewhere.
        if closer.plateaus[k] and believed and 3 <= over < 0.5 * n_changed:
            yield Finding(
                "torque_limit",
                "warning",
                f"the torque of {joint.name} reaches {statistics.saturated.value[k]:.4g} N m in"
                f" {over} of {n_changed} samples; its limit is {limit:.4g} N m",
                Cure("record a gentler motion if the drive saturates, or check the torque unit"),
                joint=joint.name,
                time=float(statistics.saturated.time[k]),
            )


def _doubt_torque_limits(model: RobotModel, statistics: FirstPass) -> Finding | None:
    """Return that one number is the torque limit of every joint, which the log exceeds."""
    limits = np.array([joint.limits.torque for joint in model.joints])
    known = np.flatnonzero(np.isfinite(limits) & (limits > 0.0))
    if not known.size:
        return None
    # Joints that stay below their limits have no value.
    reached = np.where(statistics.saturated.count > 0, np.abs(statistics.saturated.value), 0.0)
    k = known[np.argmax(reached[known])]
    if reached[k] < EXCEEDED * limits[k]:
        return None
    return doubt_limits(
        model, "torque", limits[known], f"{model.joint_names[k]} has {reached[k]:.4g}"
    )


def check_spikes(model: RobotModel, statistics: FirstPass) -> Iterator[Finding]:
    """Name joints with single torques that stand out from their neighbours: number, size, place."""
    for joint in sorted({spike.joint for spike in statistics.spikes}):
        spikes_here = [spike for spike in statistics.spikes if spike.joint == joint]
        times = np.concatenate([spike.times for spike in spikes_here])
        sizes = np.concatenate([spike.sizes for spike in spikes_here])
        worst = int(np.argmax(sizes))
        name = model.joint_names[joint]
        unit = model.joints[joint].torque_unit
        yield Finding(
            "torque_spikes",
            "warning",
            f"{times.size} of {statistics.n_samples} torques of {name} stand out from the"
            f" samples next to them, by up to {sizes[worst]:.4g} {unit} at"
            f" t = {times[worst]:.6g} s; fits use the mean of these neighbours instead",
            Cure("find out where single values come from: a hard stop, the bus or the sensor"),
            joint=name,
            time=float(times[0]),
        )


def check_noise_floor(torques: Sequence[Array], rate: float) -> Iterator[Finding]:
    """Find torques (N, n) without the noise floor of a sensor, by the mean of their spectra."""
    # Number of samples that a spectrum needs.
    long_enough = [tau for tau in torques if len(tau) >= 256]
    if not long_enough or not np.isfinite(rate):
        return
    length = min(1024, *map(len, long_enough))
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    power = np.mean([power_density(_detrend(tau), rate, length) for tau in long_enough], axis=0)
    # A torque that is constant has no spectrum.
    power = power[:, power.max(axis=0) > 0]
    if not power.size:
        return
    relative = power / power.max(axis=0)
    # Near half the rate no motion is left, only the sensor.
    floor = float(np.median(np.median(relative[frequency > 0.35 * rate], axis=0)))
    # Power at high frequency, relative to the peak, that no torque sensor falls below.
    if floor > 1e-9:
        return
    last = int(np.flatnonzero(np.median(relative, axis=1) > max(100 * floor, 1e-9))[-1])
    yield Finding(
        "already_filtered",
        "info",
        f"the torques have no power above about {frequency[last]:.2g} Hz ({floor:.0e} of the peak):"
        " they were low-pass filtered before, or simulated without noise",
        Cure(
            "expect standard errors that are too small if positions and torques were filtered"
            " differently; another filter adds little"
        ),
    )


def _find_longest_block(places: Indices) -> tuple[int, int]:
    """Return the length of the longest block of consecutive indices, and where it begins."""
    if not places.size:
        return 0, 0
    # The first index starts a block: the one prepended is two before.
    starts = np.flatnonzero(np.diff(places, prepend=places[0] - 2) != 1)
    lengths = np.diff(starts, append=places.size)
    longest = int(np.argmax(lengths))
    return int(lengths[longest]), int(starts[longest])


def _detrend(tau: Array) -> Array:
    """Return torques (N, n) without mean and trend."""
    trend = np.linspace(-1.0, 1.0, tau.shape[0])[:, None]
    # A trend leaks into all frequencies.
    level = tau - tau.mean(axis=0)
    return np.asarray(level - trend * (trend * level).sum(axis=0) / np.sum(trend**2))


def check_signs(model: RobotModel, measured: Extremes, beginning: Recording) -> Iterator[Finding]:
    """Find torques that are never negative at any joint, though joints move both ways.

    `measured` are the extremes of the torques, `beginning` the first samples of the recording,
    whose commands, if there are any, say what was logged. A joint that the model's gravity always
    loads in the positive direction says nothing.
    """
    # A weight that always pulls one way has one sign by itself.
    used = (measured.high > 0.0) & ~_mark_weight_bearing(model, beginning)
    # Joints from which it is no accident that none has a torque of the other sign.
    if np.count_nonzero(used) < 2 or np.any(measured.low < 0.0) or not _reverses(beginning):
        return
    laws = fit_magnitude_laws(beginning)
    yield Finding(
        "torque_unsigned",
        "warning",
        "no joint has a negative torque, though they move both ways: the log seems to hold"
        f" magnitudes whose sign is unknown{describe_laws(beginning.joint_names, laws)}",
        choose_sign_cure(laws),
    )


def _mark_weight_bearing(model: RobotModel, recording: Recording) -> Mask:
    """Return which joints (n,) bear a weight of one sign, positive, at all positions met."""
    q = recording.q[np.all(np.isfinite(recording.q), axis=1)]
    # Poses of a recording at which gravity is looked at.
    q = q[:: max(1, len(q) // 200)]
    weight = inverse_dynamics(model, q, np.zeros(q.shape), np.zeros(q.shape), threads=1)
    low = weight.min(axis=0, initial=np.inf)
    high = weight.max(axis=0, initial=0.0)
    # Weight, as a share of the largest, that is none but rounding.
    return np.asarray((low > 0.0) & (low > 1e-6 * high))


def _reverses(recording: Recording) -> bool:
    """Whether a joint with magnitudes moves both ways, for a tenth of its way at least."""
    for q, tau in zip(recording.q.T, recording.tau.T, strict=True):
        moved = np.diff(q[np.isfinite(q)])
        # Total way forth and back, so that a drift is no reversal.
        forth = float(moved[moved > 0].sum())
        back = float(-moved[moved < 0].sum())
        if is_magnitude(tau) and min(forth, back) > 0.1 * max(forth, back):
            return True
    return False


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
