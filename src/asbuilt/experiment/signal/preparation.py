"""Preparation of samples: the signal chain applied to a recording or a stream of chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.errors import UsageError
from asbuilt.experiment.recording import Recording, join_recordings
from asbuilt.experiment.signal.filter_plan import FilterPlan, SegmentArrays
from asbuilt.experiment.signal.prepared_motion import (
    MotionFilters,
    assemble_samples,
    plan_grid,
    settle_chain,
)
from asbuilt.experiment.signal.resampling import SHORTEST
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Cure


def resolve_chain(
    chain: SignalChain, *recordings: Recording, filters: MotionFilters | None = None
) -> SignalChain:
    """Return the chain with the cutoff and standstill speeds that it chooses for recordings.

    Others can then be treated alike. Whether logged velocities are used is decided recording by
    recording. `filters` keep the motions that were filtered for the choice.

    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> q = np.sin(2.0 * np.pi * 0.5 * t)[:, None]
    >>> round(resolve_chain(SignalChain(), Recording(t=t, q=q, tau=q)).cutoff, 2)
    7.0
    """
    if chain.cutoff is not None and (chain.rests or chain.standstill is not None):
        return chain
    filters = filters or MotionFilters()
    grids = [(recording, plan_grid(recording, chain)) for recording in recordings]
    chains = [
        settle_chain(chain, recording, grid.uniform(), grid.rate, filters)[0]
        for recording, grid in grids
    ]
    # The highest cutoff keeps every recording's motion; velocities are judged apart.
    return replace(
        max(chains, key=lambda candidate: candidate.cutoff or 0.0), velocity=chain.velocity
    )


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
    return MotionFilters().prepare(recording, chain).samples(chain.delay)


def stream_samples(
    recordings: Iterable[Recording], chain: SignalChain | None = None
) -> Iterator[Samples]:
    """Prepare a recording that comes in consecutive chunks.

    One chunk and its overlap are held at a time. Together the filtered samples equal the samples of
    `prepare_samples` on the whole, each once; what the chain leaves open is chosen from the first
    chunk.

    Raises
    ------
    UsageError
        If the chain decimates without a parallel filter, as `paper2015` does; that works on whole
        recordings only.
    """
    chain = chain or SignalChain()
    filters = MotionFilters()
    plan: FilterPlan | None = None
    held: Recording | None = None
    has_torque: Mask | None = None
    low = -np.inf
    origin = np.nan
    clock_bound = np.inf
    chunks = iter(recordings)
    following = next(chunks, None)
    while following is not None:
        chunk = following
        following = next(chunks, None)
        more = following is not None
        # A chunk is held until the next one comes, since its end has no filter response yet.
        held = joined = chunk if held is None else join_recordings([held, chunk])
        # Too short to choose a chain from.
        if joined.n_samples < SHORTEST and more:
            continue
        # The first chunk decides which joints have torque, for all.
        has_torque = joined.has_torque if has_torque is None else has_torque
        grid = plan_grid(joined, chain, plan.rate if plan else None, has_torque)
        segments = grid.uniform()
        rate = grid.rate
        notes = grid.notes
        if plan is None:
            chain, chosen, clock_bound = settle_chain(chain, joined, segments, rate, filters)
            plan = FilterPlan.of(chain, rate)
            if plan.parallel is None and plan.thinning > 1:
                raise UsageError(
                    "a chain that decimates without a parallel filter cannot process chunks",
                    cure=Cure("prepare the whole recording at once", call="prepare_samples"),
                )
            notes = (*chosen, *notes)
            origin = float(segments[0].t[0])
        parts: list[SegmentArrays] = []
        # Only the last segment of a chunk can go on.
        for k, segment in enumerate(segments):
            goes_on = more and k == len(segments) - 1
            begin = (
                # From where the last chunk ended; else the beginning is trimmed as an end.
                max(round((low - segment.t[0]) * rate), 0)
                if low > segment.t[0] - 0.5 / rate
                else plan.margin
            )
            stop = segment.t.size - (plan.support if goes_on else plan.margin)
            after = begin
            if plan.fits(segment) and stop > begin:
                cut_parts, after = plan.cut(segment, plan.motion(segment), begin, stop)
                parts.extend(cut_parts)
            if goes_on:
                low = (
                    float(segment.t[0] + after / rate)
                    if after > plan.margin or np.isfinite(low)
                    else -np.inf
                )
                # What the next outputs depend on is kept, and joined to the next chunk.
                held = joined.between(segment.t[0] + (after - plan.support - 0.5) / rate, np.inf)
        if parts:
            provenance = (*joined.notes, *notes, *plan.describe())
            samples = assemble_samples(
                joined, plan, parts, origin, has_torque, clock_bound, provenance
            )
            if samples.n_filtered:
                yield samples
