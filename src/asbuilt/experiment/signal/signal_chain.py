"""The signal chain: from a recording to the samples that identification uses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.bandwidth import motion_bandwidth
from asbuilt.experiment.signal.differentiation import central_differences
from asbuilt.experiment.signal.filter_plan import FilterPlan, Piece
from asbuilt.experiment.signal.lowpass import butterworth, settling_samples
from asbuilt.experiment.signal.resampling import SHORTEST_RUN, UniformRun, uniform_runs
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.standstill import PAUSE, standstill_speeds
from asbuilt.experiment.signal.velocity_choice import VelocityVerdict, compare_velocities

Derivative = Literal["central", "savitzky-golay", "spline"]
Velocity = Literal["auto", "measured", "derived"]

POSITION_BANDWIDTHS = 10.0
"""Default position cutoff, in bandwidths of the motion."""
SLOWEST_RATE = 1.0
"""Slower logs [Hz] tell no velocities; their clock rather counts in another unit than seconds."""
LOWEST_CUTOFF = 3.0
"""Lowest default cutoff [Hz].

However slow the motion, friction changes sign within a fraction of a second.
"""
HIGHEST_CUTOFF = 0.2
"""Highest default cutoff, as a share of the sampling rate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalChain:
    """Say how recordings become samples.

    What is None is chosen from the recording and stated in the samples' provenance.

    `cutoff` [Hz] low-passes positions with a Butterworth filter of `order` forwards and backwards,
    -3 dB of both passes (`corrected=False`: of each pass); `derivative` makes velocity and
    acceleration; `velocity` says whether logged velocities are used. `parallel` low-passes torque
    and regressor columns alike at `parallel_cutoff` [Hz], by default `cutoff`; without it the
    torque stays as it is. `rate` [Hz] resamples; `decimate` is how many logged samples make one row
    in the end; `max_gap` [s] is the longest pause that is bridged; `trimmed` drops what the ends
    disturb. Where a joint is slower than `standstill` (one speed per joint) for 0.5 s or more its
    velocity and acceleration are exactly zero, and where all joints stand for that long the samples
    are left out, unless `rests`.

    Examples
    --------
    >>> SignalChain.preset("paper2015").cutoff, SignalChain(cutoff=5.0).derivative
    (7.0, 'central')
    """

    cutoff: float | None = None
    parallel_cutoff: float | None = None
    decimate: int | None = None
    rate: float | None = None
    derivative: Derivative = "central"
    velocity: Velocity = "auto"
    parallel: bool = True
    order: int = 4
    corrected: bool = True
    trimmed: bool = True
    max_gap: float | None = None
    rests: bool = False
    standstill: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("cutoff", "parallel_cutoff", "rate", "max_gap"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name} must be a positive number, got {value}")
        if self.decimate is not None and self.decimate < 1:
            raise UsageError(f"decimate must be 1 or more, got {self.decimate}")
        if self.order < 1:
            raise UsageError(f"the order of the low-pass must be 1 or more, got {self.order}")
        for name, known in (
            ("derivative", ("central", "savitzky-golay", "spline")),
            ("velocity", ("auto", "measured", "derived")),
        ):
            if getattr(self, name) not in known:
                raise UsageError(f"{name} {getattr(self, name)!r} is not one of {', '.join(known)}")

    @classmethod
    def preset(cls, name: str) -> SignalChain:
        """Return a named chain: `default`, or `paper2015`.

        `paper2015` (Hayat, Abhishek and Saha, iNaCoMM 2015, section 4): positions through a
        second-order Butterworth at 7 Hz forwards and backwards, the double pass not corrected;
        velocity and acceleration by central differences; everything, torque included, decimated by
        10 with a Chebyshev type I filter of order 8; no parallel filter, no trimming.
        """
        presets = {
            "default": cls(),
            "paper2015": cls(
                cutoff=7.0,
                decimate=10,
                order=2,
                corrected=False,
                velocity="derived",
                parallel=False,
                trimmed=False,
                rests=True,
            ),
        }
        if name not in presets:
            raise UsageError(f"there is no signal chain {name!r}; there are {', '.join(presets)}")
        return presets[name]

    def resolved(self, *recordings: Recording) -> SignalChain:
        """Return the chain with the cutoff and standstill speeds that it would choose for these
        recordings, so that others are treated alike.

        Whether logged velocities are good is left to be decided recording by recording.
        """
        chains = [
            _resolved(self, *uniform_runs(recording, self.rate, self.max_gap)[:2])[0]
            for recording in recordings
        ]
        return replace(max(chains, key=lambda chain: chain.cutoff or 0.0), velocity=self.velocity)


def prepare_samples(recording: Recording, chain: SignalChain | None = None) -> Samples:
    """Filter, differentiate, thin and trim a recording.

    Each run of it without a gap or a rest becomes a segment.

    Raises
    ------
    RecordingError
        If no run is long enough for the filters.
    UsageError
        If a cutoff or rate is impossible for this recording.
    """
    chain = chain or SignalChain()
    runs, rate, notes = uniform_runs(recording, chain.rate, chain.max_gap)
    chain, chosen = _resolved(chain, runs, rate)
    plan = FilterPlan.of(chain, rate)
    pieces = [
        piece
        for run in runs
        if plan.fits(run)
        for piece in plan.segments(run, plan.margin, run.t.size - plan.margin)[0]
    ]
    if not pieces:
        raise RecordingError(
            f"{recording.source}: nothing is left. The longest run without a gap has"
            f" {max(run.t.size for run in runs)} samples; a low-pass at {chain.cutoff:.3g} Hz takes"
            f" {2 * plan.margin} at {rate:g} Hz, and rests are left out. Raise the cutoff, record"
            " longer, or check that the robot moves"
        )
    samples = _assembled(
        recording,
        plan,
        pieces,
        float(runs[0].t[0]),
        (*recording.notes, *notes, *chosen, *plan.description()),
    )
    if samples.parallel is not None and samples.n_filtered == 0:
        raise RecordingError(
            f"{recording.source}: no segment is as long as the parallel filter at"
            f" {samples.parallel.cutoff:.3g} Hz, {samples.parallel.taps.size / samples.rate:.3g} s;"
            " raise the cutoff or record longer"
        )
    rested = (
        sum(run.t.size - 2 * plan.margin for run in runs if plan.fits(run)) / rate
        - samples.duration
    )
    if not chain.rests and rested > PAUSE:
        samples = replace(
            samples,
            provenance=(
                *samples.provenance,
                f"{rested:.3g} s in which no joint moved were left out",
            ),
        )
    return samples


def stream_samples(
    recordings: Iterable[Recording], chain: SignalChain | None = None
) -> Iterator[Samples]:
    """Prepare a recording that comes in consecutive chunks, holding one chunk and its overlap at a
    time.

    The filtered samples of all that is yielded are those of `prepare_samples` on the whole, each
    once; what the chain chooses from a recording it chooses from the first chunk.

    Raises
    ------
    UsageError
        If the chain decimates without a parallel filter, as `paper2015` does; that works on whole
        recordings only.
    """
    chain = chain or SignalChain()
    plan: FilterPlan | None = None
    held: Recording | None = None
    low = -np.inf
    origin = np.nan
    for chunk, more in _with_more(recordings):
        joined = chunk if held is None else _joined(held, chunk)
        held = joined
        if joined.n_samples < SHORTEST_RUN and more:
            continue
        runs, rate, notes = uniform_runs(joined, plan.rate if plan else chain.rate, chain.max_gap)
        if plan is None:
            chain, chosen = _resolved(chain, runs, rate)
            plan = FilterPlan.of(chain, rate)
            if plan.parallel is None and plan.thinning > 1:
                raise UsageError(
                    "a chain that decimates without a parallel filter cannot run in chunks; prepare"
                    " the whole recording at once"
                )
            notes = (*chosen, *notes)
            origin = float(runs[0].t[0])
        pieces: list[Piece] = []
        for k, run in enumerate(runs):
            goes_on = more and k == len(runs) - 1
            begin = (
                max(round((low - run.t[0]) * rate), 0)
                if np.isfinite(low) and low > run.t[0] - 0.5 / rate
                else plan.margin
            )
            stop = run.t.size - (plan.reach if goes_on else plan.margin)
            after = begin
            if plan.fits(run) and stop > begin:
                found, after = plan.segments(run, begin, stop)
                pieces.extend(found)
            if goes_on:
                low = (
                    float(run.t[0] + after / rate)
                    if after > plan.margin or np.isfinite(low)
                    else -np.inf
                )
                held = joined.between(run.t[0] + (after - plan.reach - 0.5) / rate, np.inf)
        if pieces:
            samples = _assembled(
                joined, plan, pieces, origin, (*joined.notes, *notes, *plan.description())
            )
            if samples.n_filtered:
                yield samples


def _resolved(
    chain: SignalChain, runs: Sequence[UniformRun], rate: float
) -> tuple[SignalChain, tuple[str, ...]]:
    notes: list[str] = []
    if rate < SLOWEST_RATE:
        raise RecordingError(
            f"{rate:.3g} samples a second are too few to differentiate; are the time stamps in"
            " seconds?"
        )
    longest = max(run.t.size for run in runs) / rate
    if chain.cutoff is not None and chain.cutoff * longest < 0.1:
        raise UsageError(
            f"a low-pass at {chain.cutoff:.3g} Hz leaves nothing of a recording whose longest run"
            f" without a gap lasts {longest:.3g} s; raise the cutoff"
        )
    if chain.cutoff is None:
        bandwidth = motion_bandwidth([run.q for run in runs], rate)
        cutoff = min(max(POSITION_BANDWIDTHS * bandwidth, LOWEST_CUTOFF), HIGHEST_CUTOFF * rate)
        chain = replace(chain, cutoff=cutoff)
        notes.append(
            f"95 % of the velocity's power lies below {bandwidth:.3g} Hz; positions are kept up to"
            f" {cutoff:.3g} Hz"
        )
    if chain.velocity == "auto":
        verdict = _velocity_verdict(chain, runs, rate)
        chain = replace(
            chain, velocity="measured" if verdict is not None and verdict.helps else "derived"
        )
        notes.extend([str(verdict)] if verdict is not None else [])
    elif chain.velocity == "measured" and any(run.qd is None for run in runs):
        raise UsageError(
            "measured velocities were asked for, but the recording has none, or not for every"
            " sample; leave velocity at 'auto'"
        )
    if chain.standstill is None and not chain.rests:
        plan = FilterPlan.of(chain, rate)
        fitting = [run for run in runs if plan.fits(run)]
        if fitting:
            chain = replace(
                chain, standstill=standstill_speeds([plan.motion(run)[1] for run in fitting])
            )
    return chain, tuple(notes)


def _velocity_verdict(
    chain: SignalChain, runs: Sequence[UniformRun], rate: float
) -> VelocityVerdict | None:
    cutoff, order = chain.cutoff or 0.0, chain.order
    pairs = []
    for run in runs:
        if run.qd is None:
            return None
        if run.t.size > 2 * settling_samples(cutoff, rate, order=order):
            derived = central_differences(run.q, rate)
            smooth, logged = (
                butterworth(x, cutoff=cutoff, rate=rate, order=order) for x in (derived, run.qd)
            )
            pairs.append((smooth, logged, derived, run.qd))
    return compare_velocities(pairs, rate) if pairs else None


def _assembled(
    recording: Recording,
    plan: FilterPlan,
    pieces: list[Piece],
    origin: float,
    provenance: tuple[str, ...],
) -> Samples:
    bounds = [0, *np.cumsum([piece[0].size for piece in pieces]).tolist()]
    t, q, qd, qdd, tau, tau_raw = (
        np.concatenate(parts) if len(pieces) > 1 else parts[0]
        for parts in zip(*pieces, strict=True)
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
