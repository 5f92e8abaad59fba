"""Preparation of samples: the signal chain applied to a recording or a stream of chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.recording import Recording, join_recordings
from asbuilt.experiment.signal.band_choice import choose_band
from asbuilt.experiment.signal.differentiation import (
    PAUSE,
    estimate_standstill_speeds,
    validate_velocities,
)
from asbuilt.experiment.signal.filter_plan import FilteredMotion, FilterPlan, SegmentArrays
from asbuilt.experiment.signal.lowpass import SPREAD
from asbuilt.experiment.signal.resampling import (
    SHORTEST,
    Grid,
    UniformSegment,
    plan_uniform_grid,
    replace_spikes,
)
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import Delay, SignalChain
from asbuilt.findings import Cure

SLOWEST_RATE = 1.0
"""Lowest rate [Hz] at which velocities can be derived; slower clocks count in another unit."""

Found = TypeVar("Found")


class MotionFilters:
    """Filter every motion once, whatever torque is to go with it; one serves a whole study."""

    def __init__(self) -> None:
        self._kept: list[tuple[object, list[Array], object]] = []

    def prepare(self, recording: Recording, chain: SignalChain | None = None) -> PreparedMotion:
        """Return the filtered motion of a recording; what the chain leaves open is chosen for it.

        Raises
        ------
        UsageError
            If a cutoff or rate is impossible for this recording.
        """
        # The delay shifts torques alone: motions are the same for all of them.
        asked = replace(chain or SignalChain(), delay=None)
        grid = plan_grid(recording, asked)
        segments = grid.uniform()
        settled, notes, bound = settle_chain(asked, recording, segments, grid.rate, self)
        # Pauses that the chosen filter does not resolve no longer divide: the grid is planned
        # again.
        if asked.cutoff is None:
            grid = plan_grid(recording, settled)
            segments = grid.uniform()
        plan = FilterPlan.of(settled, grid.rate)
        motions = (
            self.motion(plan, segment) if plan.fits(segment) else None for segment in segments
        )
        return PreparedMotion(recording, plan, grid, notes, tuple(segments), tuple(motions), bound)

    def motion(self, plan: FilterPlan, segment: UniformSegment) -> FilteredMotion:
        """Return the filtered motion of a segment."""
        chain = plan.chain
        filters = (chain.cutoff, chain.order, chain.corrected, chain.derivative, chain.velocity)
        return self.once(("motion", plan.rate, *filters), [segment], lambda: plan.motion(segment))

    def once(
        self, what: object, segments: Sequence[UniformSegment], make: Callable[[], Found]
    ) -> Found:
        """Return what is made of the motion of segments, as it was made before if it was."""
        # By value: segments of the same motion are made anew for each question.
        arrays = [x for segment in segments for x in (segment.q, segment.qd) if x is not None]
        for known, before, made_before in self._kept:
            same = known == what and len(before) == len(arrays)
            if same and all(map(np.array_equal, before, arrays)):
                return made_before  # type: ignore[return-value]
        made = make()
        self._kept.append((what, arrays, made))
        return made


@dataclass(frozen=True, eq=False)
class PreparedMotion:
    """Hold the filtered motion of a recording, with which torques at any delay are samples.

    Delays shift the torque; the samples stay, but for ends where no torque was logged.

    Parameters
    ----------
    recording
        The recording.
    plan
        Its filters, all choices settled, without a delay.
    grid, notes
        Its segments on a uniform clock, and sentences about the choices.
    segments, motions
        The segments, and the filtered motion of each; None of those too short for the filters.
    clock_bound
        Largest error of the clock, as a share, that logged velocities admit.
    """

    recording: Recording
    plan: FilterPlan
    grid: Grid
    notes: tuple[str, ...]
    segments: tuple[UniformSegment, ...]
    motions: tuple[FilteredMotion | None, ...]
    clock_bound: float

    def with_torque(self, tau: Array) -> PreparedMotion:
        """Return the motion with another signal (N, n), finite where the torque is, for torque."""
        recording = replace(self.recording, tau=tau)
        # As in the recording: a channel that is constant is none.
        channel = self.grid.channel(recording.with_torque_of(recording.has_torque).tau)
        segments = tuple(
            replace(segment, tau=tau) for segment, tau in zip(self.segments, channel, strict=True)
        )
        return replace(self, recording=recording, segments=segments)

    def samples(self, delay: Delay = None) -> Samples:
        """Return samples whose torque is shifted back by a delay [s].

        Raises
        ------
        RecordingError
            If no segment is long enough for the filters.
        UsageError
            If delays are of another number of joints.
        """
        recording = self.recording
        rate = self.plan.rate
        plan = replace(self.plan, chain=replace(self.plan.chain, delay=delay))
        parts = list[SegmentArrays]()
        seconds = 0.0
        for segment, motion in zip(self.segments, self.motions, strict=True):
            if motion is not None:
                # Ends that the filter has not settled at are cut, whichever torque is there.
                stop = segment.t.size - plan.margin
                parts += plan.cut(segment, motion, plan.margin, stop)[0]
                seconds += (stop - plan.margin) / rate
        if not parts:
            longest = max(segment.t.size for segment in self.segments)
            raise RecordingError(
                f"{recording.source}: no samples are left. The longest segment without a gap has"
                f" {longest} samples, a low-pass at {plan.chain.cutoff:.3g} Hz takes"
                f" {2 * plan.margin} at {rate:g} Hz, and rests are left out",
                cure=Cure("raise the cutoff, record longer, or check that the robot moves"),
                file=recording.source,
                value=longest,
                lower=2 * plan.margin,
            )
        samples = assemble_samples(
            recording,
            plan,
            parts,
            float(self.segments[0].t[0]),
            recording.has_torque,
            self.clock_bound,
            (*recording.notes, *self.grid.notes, *self.notes, *plan.describe()),
        )
        samples = self._with_second_encoder(samples)
        # Enough for the low-pass may be too little for the filter after it.
        if samples.parallel is not None and samples.n_filtered == 0:
            raise RecordingError(
                f"{recording.source}: no segment is as long as the parallel filter at"
                f" {samples.parallel.cutoff:.3g} Hz,"
                f" {samples.parallel.taps.size / samples.rate:.3g} s",
                cure=Cure("raise the cutoff or record longer"),
                file=recording.source,
            )
        # What is neither kept nor trimmed was rest.
        rested = seconds - samples.duration
        if plan.chain.rests or rested <= PAUSE:
            return samples
        left_out = f"{rested:.3g} s in which all joints are at rest were left out"
        return replace(samples, provenance=(*samples.provenance, left_out))

    def _with_second_encoder(self, samples: Samples) -> Samples:
        """Return samples with the motion by a second encoder, filtered like that by the first."""
        second = self.recording.second_encoder
        if second is None or not np.isfinite(second[1]).all():
            return samples
        side, positions = second
        parts = [
            (segment.t, np.stack(self.plan.motion(replace(segment, q=q, qd=None, qdd=None))))
            for segment, q in zip(self.segments, self.grid.channel(positions), strict=True)
            if self.plan.fits(segment)
        ]
        # The same instants as the samples: filters are alike, rests are left out of one only.
        at = np.searchsorted(np.concatenate([t for t, _ in parts]), samples.t)
        moved = np.concatenate([motion for _, motion in parts], axis=1)
        return replace(samples, encoder=moved[:, at], encoder_at=side)


def _end_response(chain: SignalChain, recording: Recording) -> SignalChain:
    """Return the chain for a recording with touch-downs, if it is one: its response ends.

    A touch-down is an acceleration without bound for the log. Wherever a low-pass spreads it, its
    force has to be projected away, so the response must end; a Butterworth filter rings on for 1.6
    periods.
    """
    if chain.derivative == "central" and recording.has_touch_downs:
        return replace(chain, derivative="gaussian")
    return chain


def plan_grid(
    recording: Recording,
    chain: SignalChain,
    rate: float | None = None,
    has_torque: Mask | None = None,
) -> Grid:
    """Return segments on a uniform clock; pauses that the filter does not resolve do not divide.

    Single torques that stand out have the mean of their neighbours; joints without torque have 0.
    """
    # In a quarter of a period a sine at the cutoff turns by as much.
    resolved = 0.0 if chain.cutoff is None else 0.25 / chain.cutoff
    recording = recording.with_torque_of(recording.has_torque if has_torque is None else has_torque)
    return plan_uniform_grid(replace_spikes(recording), rate or chain.rate, chain.max_gap, resolved)


def settle_chain(
    chain: SignalChain,
    recording: Recording,
    segments: Sequence[UniformSegment],
    rate: float,
    filters: MotionFilters,
) -> tuple[SignalChain, tuple[str, ...], float]:
    """Return the chain with its choices made, sentences about them, and a bound of the clock.

    The bound is `Samples.clock_bound`.
    """
    chain = _end_response(chain, recording)
    computed = recording.has_computed_torque
    notes = list[str]()
    clock_bound = np.inf
    # Checked before anything is chosen: no cutoff suits such a clock.
    if rate < SLOWEST_RATE:
        raise RecordingError(
            f"a sampling rate of {rate:.3g} Hz is too low to differentiate positions; at least"
            f" {SLOWEST_RATE:g} Hz is required",
            cure=Cure("check that the time stamps are in seconds"),
            value=rate,
            lower=SLOWEST_RATE,
        )
    longest = max(segment.t.size for segment in segments) / rate
    # Less than a tenth of a period is a constant.
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
        band = choose_band(segments, rate, computed=computed)
        # Velocities are compared with the derivative under the cutoff of the positions.
        chain = replace(chain, cutoff=band.cutoff)
    if chain.velocity == "auto":
        verdict = filters.once(
            ("velocity", rate, chain.cutoff, chain.order),
            segments,
            lambda: validate_velocities(segments, rate, chain.cutoff or 0.0, chain.order),
        )
        chain = replace(
            chain, velocity="measured" if verdict is not None and verdict.helps else "derived"
        )
        if verdict is not None:
            notes.append(str(verdict))
            clock_bound = verdict.clock_bound
    elif chain.velocity == "measured" and any(segment.qd is None for segment in segments):
        raise UsageError(
            "the chain uses measured velocities, but the recording has none, or not for every"
            " sample",
            cure=Cure("let the chain choose", settings={"velocity": "auto"}),
        )
    if band is not None:
        if chain.velocity == "measured":
            band = choose_band(segments, rate, of_velocity=True, computed=computed)
            # Noise of logged velocities, not of positions, then limits the band.
            chain = replace(chain, cutoff=band.cutoff)
        notes.insert(0, str(band))
    if chain.standstill is None and not chain.rests:
        plan = FilterPlan.of(chain, rate)
        motions = [filters.motion(plan, segment)[:2] for segment in segments if plan.fits(segment)]
        # Rests are recognised in the filtered motion, whose noise is what is left.
        if motions:
            chain = replace(
                chain, standstill=estimate_standstill_speeds(motions, chain.cutoff or 0.0)
            )
    return chain, tuple(notes), clock_bound


def assemble_samples(
    recording: Recording,
    plan: FilterPlan,
    parts: list[SegmentArrays],
    origin: float,
    has_torque: Mask,
    clock_bound: float,
    provenance: tuple[str, ...],
) -> Samples:
    """Return the samples of the parts of a recording that began at `origin` [s]."""
    bounds = [0, *np.cumsum([part[0].size for part in parts]).tolist()]
    t, q, qd, qdd, tau, tau_raw = (
        np.concatenate(column) if len(parts) > 1 else column[0]
        for column in zip(*parts, strict=True)
    )
    # Logged rates are differences by whoever logged them, which take a sample to either side.
    logged = 1.0 / plan.rate if plan.chain.velocity == "measured" else 0.0
    # Reactions last over the width of the filter: it spreads them so far.
    reactions = recording.reactions_at(t, SPREAD / (plan.chain.cutoff or np.inf) + logged)
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
        # An infinite slowest speed leaves out every row of a joint without torque.
        slowest=() if has_torque.all() else tuple(np.where(has_torque, 0.0, np.inf).tolist()),
        clock_bound=clock_bound,
        reactions=reactions,
        pose_noise=plan.pose_noise(recording.q) if reactions else (),
    )


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
