"""Preparation of samples: the signal chain applied to a recording or a stream of chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.differentiation import central_differences
from asbuilt.experiment.signal.filter_plan import FilterPlan, SegmentArrays
from asbuilt.experiment.signal.lowpass import butterworth, settling_samples
from asbuilt.experiment.signal.noise.band_choice import choose_band
from asbuilt.experiment.signal.noise.spikes import without_spikes
from asbuilt.experiment.signal.resampling import (
    SHORTEST,
    UniformSegment,
    advanced,
    uniform_segments,
)
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.experiment.signal.standstill import PAUSE, standstill_speeds
from asbuilt.experiment.signal.velocity_choice import VelocityVerdict, compare_velocities
from asbuilt.findings import Cure

UNRESOLVED = 0.25
"""Longest pause that is bridged, in periods of the cutoff: there a sine at the cutoff turns by a
quarter.
"""
SLOWEST_RATE = 1.0
"""Lowest rate [Hz] at which velocities can be derived; slower clocks count in another unit."""


def resolve_chain(chain: SignalChain, *recordings: Recording) -> SignalChain:
    """Return the chain with the cutoff and standstill speeds that it chooses for recordings.

    Others can then be treated alike. Whether logged velocities are used is decided recording by
    recording.

    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> q = np.sin(2.0 * np.pi * 0.5 * t)[:, None]
    >>> round(resolve_chain(SignalChain(), Recording(t=t, q=q, tau=q)).cutoff, 2)
    7.0
    """
    if chain.cutoff is not None and (chain.rests or chain.standstill is not None):
        return chain
    chains = [
        _resolved(chain, *_segments(recording, chain)[:2], _commanded(recording))[0]
        for recording in recordings
    ]
    return replace(max(chains, key=lambda each: each.cutoff or 0.0), velocity=chain.velocity)


def prepare_samples(recording: Recording, chain: SignalChain | None = None) -> Samples:
    """Filter, differentiate, thin and trim a recording.

    Parameters
    ----------
    recording
        The recording.
    chain
        The signal chain; None is the default one.

    Returns
    -------
    Samples
        Each part of the recording without a gap or a rest is a segment.

    Raises
    ------
    RecordingError
        If no segment is long enough for the filters.
    UsageError
        If a cutoff or rate is impossible for this recording.

    Examples
    --------
    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> q = np.sin(2.0 * np.pi * 0.5 * t)[:, None]
    >>> samples = prepare_samples(Recording(t=t, q=q, tau=q), SignalChain(cutoff=5.0))
    >>> samples.rate, samples.n_joints
    (100.0, 1)
    """
    chain = chain or SignalChain()
    segments, rate, notes = _segments(recording, chain)
    is_open = chain.cutoff is None
    chain, chosen, verdict = _resolved(chain, segments, rate, _commanded(recording))
    if is_open:
        segments, rate, notes = _segments(recording, chain)
    plan, origin = FilterPlan.of(chain, rate), float(segments[0].t[0])
    segments = _advanced(segments, chain, rate)
    parts = [
        part
        for segment in segments
        if plan.fits(segment)
        for part in plan.arrays(segment, plan.margin, segment.t.size - plan.margin)[0]
    ]
    if not parts:
        longest = max(segment.t.size for segment in segments)
        raise RecordingError(
            f"{recording.source}: no samples are left. The longest segment without a gap has"
            f" {longest} samples, a low-pass at {chain.cutoff:.3g} Hz takes {2 * plan.margin} at"
            f" {rate:g} Hz, and rests are left out",
            cure=Cure("raise the cutoff, record longer, or check that the robot moves"),
            file=recording.source,
            value=longest,
            lower=2 * plan.margin,
        )
    samples = _assembled(
        recording,
        plan,
        parts,
        origin,
        recording.has_torque,
        verdict,
        (*recording.notes, *notes, *chosen, *plan.description()),
    )
    if samples.parallel is not None and samples.n_filtered == 0:
        raise RecordingError(
            f"{recording.source}: no segment is as long as the parallel filter at"
            f" {samples.parallel.cutoff:.3g} Hz, {samples.parallel.taps.size / samples.rate:.3g} s",
            cure=Cure("raise the cutoff or record longer"),
            file=recording.source,
        )
    rested = (
        sum(segment.t.size - 2 * plan.margin for segment in segments if plan.fits(segment)) / rate
        - samples.duration
    )
    if not chain.rests and rested > PAUSE:
        samples = replace(
            samples,
            provenance=(
                *samples.provenance,
                f"{rested:.3g} s in which all joints are at rest were left out",
            ),
        )
    return samples


def stream_samples(
    recordings: Iterable[Recording], chain: SignalChain | None = None
) -> Iterator[Samples]:
    """Prepare a recording that comes in consecutive chunks.

    One chunk and its overlap are held at a time. Together the filtered samples are those of
    `prepare_samples` on the whole, each once; what the chain leaves open is chosen from the first
    chunk.

    Raises
    ------
    UsageError
        If the chain decimates without a parallel filter, as `paper2015` does; that works on whole
        recordings only.
    """
    chain = chain or SignalChain()
    plan: FilterPlan | None = None
    held: Recording | None = None
    has_torque: Mask | None = None
    verdict: VelocityVerdict | None = None
    low = -np.inf
    origin = np.nan
    for chunk, more in _with_more(recordings):
        joined = chunk if held is None else _joined(held, chunk)
        held = joined
        if joined.n_samples < SHORTEST and more:
            continue
        has_torque = joined.has_torque if has_torque is None else has_torque
        segments, rate, notes = _segments(joined, chain, plan.rate if plan else None, has_torque)
        if plan is None:
            chain, chosen, verdict = _resolved(chain, segments, rate, _commanded(joined))
            plan = FilterPlan.of(chain, rate)
            if plan.parallel is None and plan.thinning > 1:
                raise UsageError(
                    "a chain that decimates without a parallel filter cannot process chunks",
                    cure=Cure("prepare the whole recording at once", call="prepare_samples"),
                )
            notes = (*chosen, *notes)
            origin = float(segments[0].t[0])
        segments = _advanced(segments, chain, rate)
        parts: list[SegmentArrays] = []
        for k, segment in enumerate(segments):
            goes_on = more and k == len(segments) - 1
            begin = (
                max(round((low - segment.t[0]) * rate), 0)
                if np.isfinite(low) and low > segment.t[0] - 0.5 / rate
                else plan.margin
            )
            stop = segment.t.size - (plan.support if goes_on else plan.margin)
            after = begin
            if plan.fits(segment) and stop > begin:
                found, after = plan.arrays(segment, begin, stop)
                parts.extend(found)
            if goes_on:
                low = (
                    float(segment.t[0] + after / rate)
                    if after > plan.margin or np.isfinite(low)
                    else -np.inf
                )
                held = joined.between(segment.t[0] + (after - plan.support - 0.5) / rate, np.inf)
        if parts:
            samples = _assembled(
                joined,
                plan,
                parts,
                origin,
                has_torque,
                verdict,
                (*joined.notes, *notes, *plan.description()),
            )
            if samples.n_filtered:
                yield samples


def _segments(
    recording: Recording,
    chain: SignalChain,
    rate: float | None = None,
    has_torque: Mask | None = None,
) -> tuple[list[UniformSegment], float, tuple[str, ...]]:
    """Return uniform segments; pauses that the filter does not resolve do not divide them.

    Single torques that stand out have the mean of their neighbours; joints without torque have 0.
    """
    resolved = 0.0 if chain.cutoff is None else UNRESOLVED / chain.cutoff
    recording = recording.with_torque_of(recording.has_torque if has_torque is None else has_torque)
    return uniform_segments(without_spikes(recording), rate or chain.rate, chain.max_gap, resolved)


def _commanded(recording: Recording) -> bool:
    """Return whether the torque of a recording is that of a command."""
    return recording.torque_source == "command"


def _resolved(
    chain: SignalChain,
    segments: Sequence[UniformSegment],
    rate: float,
    commanded: bool = False,
) -> tuple[SignalChain, tuple[str, ...], VelocityVerdict | None]:
    notes: list[str] = []
    verdict: VelocityVerdict | None = None
    if rate < SLOWEST_RATE:
        raise RecordingError(
            f"a sampling rate of {rate:.3g} Hz is too low to differentiate positions; at least"
            f" {SLOWEST_RATE:g} Hz is required",
            cure=Cure("check that the time stamps are in seconds"),
            value=rate,
            lower=SLOWEST_RATE,
        )
    longest = max(segment.t.size for segment in segments) / rate
    if chain.cutoff is not None and chain.cutoff * longest < 0.1:
        raise UsageError(
            f"a low-pass at {chain.cutoff:.3g} Hz leaves nothing of a recording whose longest"
            f" segment without a gap lasts {longest:.3g} s",
            cure=Cure("raise the cutoff"),
            value=chain.cutoff,
            lower=0.1 / longest,
        )
    band = None
    if chain.cutoff is None:
        band = choose_band(segments, rate, commanded=commanded)
        chain = replace(chain, cutoff=band.cutoff)
    if chain.velocity == "auto":
        verdict = _velocity_verdict(chain, segments, rate)
        chain = replace(
            chain, velocity="measured" if verdict is not None and verdict.helps else "derived"
        )
        notes.extend([str(verdict)] if verdict is not None else [])
    elif chain.velocity == "measured" and any(segment.qd is None for segment in segments):
        raise UsageError(
            "the chain uses measured velocities, but the recording has none, or not for every"
            " sample",
            cure=Cure("let the chain choose", settings={"velocity": "auto"}),
        )
    if band is not None:
        if chain.velocity == "measured":
            band = choose_band(segments, rate, of_velocity=True, commanded=commanded)
            chain = replace(chain, cutoff=band.cutoff)
        notes.insert(0, str(band))
    if chain.standstill is None and not chain.rests:
        plan = FilterPlan.of(chain, rate)
        fitting = [segment for segment in segments if plan.fits(segment)]
        if fitting:
            motions = [plan.motion(segment)[:2] for segment in fitting]
            chain = replace(chain, standstill=standstill_speeds(motions, chain.cutoff or 0.0))
    return chain, tuple(notes), verdict


def _advanced(
    segments: list[UniformSegment], chain: SignalChain, rate: float
) -> list[UniformSegment]:
    """Return segments with the torque shifted back by the known delay of the chain."""
    if not chain.delays:
        return segments
    n = segments[0].q.shape[1]
    if len(chain.delays) not in (1, n):
        raise UsageError(
            f"a delay is one number for all joints or one for each of {n}, got {len(chain.delays)}"
        )
    delay = np.broadcast_to(chain.delays, (n,))
    return [advanced(segment, delay, rate) for segment in segments]


def _velocity_verdict(
    chain: SignalChain, segments: Sequence[UniformSegment], rate: float
) -> VelocityVerdict | None:
    cutoff, order = chain.cutoff or 0.0, chain.order
    pairs = []
    for segment in segments:
        if segment.qd is None:
            return None
        if segment.t.size > 2 * settling_samples(cutoff, rate, order=order):
            derived = central_differences(segment.q, rate)
            smooth, logged = (
                butterworth(x, cutoff=cutoff, rate=rate, order=order) for x in (derived, segment.qd)
            )
            pairs.append((smooth, logged, derived, segment.qd))
    return compare_velocities(pairs, rate) if pairs else None


def _assembled(
    recording: Recording,
    plan: FilterPlan,
    parts: list[SegmentArrays],
    origin: float,
    has_torque: Mask,
    verdict: VelocityVerdict | None,
    provenance: tuple[str, ...],
) -> Samples:
    bounds = [0, *np.cumsum([part[0].size for part in parts]).tolist()]
    t, q, qd, qdd, tau, tau_raw = (
        np.concatenate(column) if len(parts) > 1 else column[0]
        for column in zip(*parts, strict=True)
    )
    return Samples(
        t=t,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=tau,
        tau_raw=tau_raw,
        rate=plan.rate / plan.thinning,
        joint_names=recording.joint_names,
        segments=tuple(pairwise(bounds)),
        source=recording.source,
        torque_source=recording.torque_source,
        parallel=plan.parallel,
        origin=origin,
        provenance=provenance,
        delay=plan.chain.delays,
        slowest=() if has_torque.all() else tuple(np.where(has_torque, 0.0, np.inf).tolist()),
        clock_bound=np.inf if verdict is None else verdict.clock_bound,
    )


def _joined(first: Recording, second: Recording) -> Recording:
    qd = None if first.qd is None or second.qd is None else np.concatenate([first.qd, second.qd])
    t, q, tau = (
        np.concatenate(pair)
        for pair in ((first.t, second.t), (first.q, second.q), (first.tau, second.tau))
    )
    return replace(second, t=t, q=q, tau=tau, qd=qd, qdd=None, extra={})


def _with_more(recordings: Iterable[Recording]) -> Iterator[tuple[Recording, bool]]:
    iterator = iter(recordings)
    for current in iterator:
        chunk = current
        for following in iterator:
            yield chunk, True
            chunk = following
        yield chunk, False
