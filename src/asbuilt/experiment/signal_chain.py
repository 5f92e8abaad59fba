"""The signal chain: from a recording to the samples that identification uses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.bandwidth import motion_bandwidth
from asbuilt.experiment.differentiation import central_differences, savitzky_golay, savitzky_golay_window, smoothing_spline
from asbuilt.experiment.lowpass import butterworth, decimate_chebyshev, settling_samples
from asbuilt.experiment.parallel_filter import STOP_BAND_EDGE, ParallelFilter, design_parallel_filter
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.resampling import UniformRun, uniform_runs
from asbuilt.experiment.samples import Samples

Array = NDArray[np.float64]
Derivative = Literal["central", "savitzky-golay", "spline"]
Velocity = Literal["auto", "measured", "derived"]

POSITION_BANDWIDTHS = 12.0
"""Default position cutoff, in bandwidths of the motion."""
PARALLEL_SHARE = 0.5
"""Default cutoff of the parallel filter, as a share of the position cutoff."""
LOWEST_RATE = 100.0
"""Logs are not thinned below this rate [Hz] before the regressor is evaluated."""
RATE_IN_CUTOFFS = 12.0
"""Nor below this multiple of the position cutoff."""
EXACT = 1e-11
"""Where the low-pass's impulse response has fallen to this share of its peak, what lies beyond does not matter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalChain:
    """Say how recordings become samples; what is None is chosen from the recording and stated in the samples' provenance.

    `cutoff` [Hz] low-passes positions (-3 dB of both passes; `corrected=False`: of each pass) with a Butterworth filter of `order`;
    `derivative` makes velocity and acceleration; `velocity` says whether logged velocities are used. `parallel` filters torque and regressor columns alike at
    `parallel_cutoff` [Hz] instead of the torque alone. `rate` [Hz] resamples; `decimate` is the number of logged samples per sample used in the end, `max_gap` [s]
    the longest pause that is bridged.

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

    def __post_init__(self) -> None:
        for name in ("cutoff", "parallel_cutoff", "rate", "max_gap"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name} must be a positive number, got {value}")
        if self.decimate is not None and self.decimate < 1:
            raise UsageError(f"decimate must be 1 or more, got {self.decimate}")
        if self.order < 1:
            raise UsageError(f"the order of the low-pass must be 1 or more, got {self.order}")
        for name, known in (("derivative", ("central", "savitzky-golay", "spline")), ("velocity", ("auto", "measured", "derived"))):
            if getattr(self, name) not in known:
                raise UsageError(f"{name} {getattr(self, name)!r} is not one of {', '.join(known)}")

    @classmethod
    def preset(cls, name: str) -> SignalChain:
        """Return a named chain: `default`, or `paper2015`.

        `paper2015` (Hayat, Abhishek and Saha, iNaCoMM 2015, section 4): positions through a second-order Butterworth at 7 Hz forwards and backwards, the
        double pass not corrected; velocity and acceleration by central differences; everything, torque included, decimated by 10 with a
        Chebyshev type I filter of order 8; no parallel filter, no trimming.
        """
        presets = {
            "default": cls(),
            "paper2015": cls(cutoff=7.0, decimate=10, order=2, corrected=False, velocity="derived", parallel=False, trimmed=False),
        }
        if name not in presets:
            raise UsageError(f"there is no signal chain {name!r}; there are {', '.join(presets)}")
        return presets[name]

    def resolved(self, *recordings: Recording) -> SignalChain:
        """Return the chain with the cutoffs that it would choose for these recordings, so that others are treated alike."""
        cutoffs = [_resolved(self, *uniform_runs(recording, self.rate, self.max_gap)[:2])[0] for recording in recordings]
        return max(cutoffs, key=lambda chain: chain.cutoff or 0.0)

    def overlap_samples(self, rate: float) -> int:
        """Return how many logged samples at `rate` [Hz] on either side of an instant its samples depend on (to 1e-10); needs cutoffs."""
        plan = _Plan.of(self, rate)
        return plan.exact + (plan.parallel.margin * plan.thinning if plan.parallel else 0)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What a chain comes to at one rate: filters, factors and margins (in logged samples)."""

    chain: SignalChain
    rate: float
    thinning: int
    anti_alias: ParallelFilter | None
    parallel: ParallelFilter | None
    margin: int
    exact: int

    @classmethod
    def of(cls, chain: SignalChain, rate: float) -> _Plan:
        cutoff, total = chain.cutoff, chain.decimate
        if cutoff is None:
            raise UsageError("this chain has no cutoff yet; give one or take it from a recording with chain.resolved(recording)")
        if chain.derivative == "savitzky-golay":
            margin = exact = savitzky_golay_window(cutoff, rate) // 2
        else:
            margin = settling_samples(cutoff, rate, order=chain.order, corrected=chain.corrected)
            exact = settling_samples(cutoff, rate, order=chain.order, corrected=chain.corrected, tolerance=EXACT)
        if not chain.parallel:
            return cls(chain, rate, total or 1, None, None, margin if chain.trimmed else 0, exact)
        low = chain.parallel_cutoff or PARALLEL_SHARE * cutoff
        thinning = max(1, int(rate / max(LOWEST_RATE, RATE_IN_CUTOFFS * cutoff) + 1e-9))
        if total is not None:
            thinning = max(factor for factor in range(1, thinning + 1) if total % factor == 0)
        factor = total // thinning if total is not None else max(1, int(rate / thinning / (4.0 * low)))
        if total is not None and chain.parallel_cutoff is None:
            low = min(low, rate / total / (2.0 * STOP_BAND_EDGE))
        anti_alias = design_parallel_filter(0.25 * rate / thinning, rate, thinning) if thinning > 1 else None
        parallel = design_parallel_filter(low, rate / thinning, factor)
        return cls(chain, rate, thinning, anti_alias, parallel, margin if chain.trimmed else 0, exact)


def prepare_samples(recording: Recording, chain: SignalChain | None = None) -> Samples:
    """Filter, differentiate, thin and trim a recording; each gapless run of it becomes a segment.

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
    plan = _Plan.of(chain, rate)
    pieces = [piece for run in runs if (piece := _prepared(run, plan, plan.margin, plan.margin)) is not None]
    if not pieces:
        longest = max(run.t.size for run in runs)
        needed = 2 * plan.margin + 1
        raise RecordingError(
            f"{recording.source}: the longest run without a gap has {longest} samples, but a low-pass at {chain.cutoff:g} Hz needs more than {needed} "
            f"at {rate:g} Hz; raise the cutoff or record longer"
        )
    return _assembled(recording, plan, pieces, (*recording.notes, *notes, *chosen, *_described(plan, len(runs) - len(pieces))))


def _resolved(chain: SignalChain, runs: list[UniformRun], rate: float) -> tuple[SignalChain, tuple[str, ...]]:
    notes: list[str] = []
    if chain.cutoff is None:
        bandwidth = motion_bandwidth([run.q for run in runs], rate)
        cutoff = min(POSITION_BANDWIDTHS * bandwidth, 0.25 * rate)
        chain = replace(chain, cutoff=cutoff)
        notes.append(
            f"95 % of the velocity's power lies below {bandwidth:.3g} Hz; positions are kept up to {cutoff / bandwidth:.3g} times that"
        )
    if chain.velocity == "auto":
        chain = replace(chain, velocity="derived")
    elif chain.velocity == "measured" and any(run.qd is None for run in runs):
        raise UsageError("measured velocities were asked for, but the recording has none (or not for every sample)")
    return chain, tuple(notes)


def _motion(run: UniformRun, plan: _Plan) -> tuple[Array, Array, Array]:
    """Return q, qd, qdd (L, n) at the logged rate."""
    chain, rate = plan.chain, plan.rate
    cutoff = chain.cutoff or 0.0
    if chain.derivative == "savitzky-golay":
        q, qd, qdd = savitzky_golay(run.q, rate, cutoff=cutoff)
    elif chain.derivative == "spline":
        q, qd, qdd = smoothing_spline(run.q, rate, cutoff=cutoff)
    else:
        q = butterworth(run.q, cutoff=cutoff, rate=rate, order=chain.order, corrected=chain.corrected)
        qd = central_differences(q, rate)
        qdd = central_differences(qd, rate)
    if chain.velocity == "measured" and run.qd is not None:
        qd = butterworth(run.qd, cutoff=cutoff, rate=rate, order=chain.order, corrected=chain.corrected)
        qdd = central_differences(qd, rate)
    return q, qd, qdd


Piece = tuple[Array, Array, Array, Array, Array, Array]
"""t, q, qd, qdd, tau, tau_raw of one segment."""


def _prepared(run: UniformRun, plan: _Plan, lead: int, tail: int) -> Piece | None:
    """Return one segment, without its first `lead` and last `tail` samples; None where nothing would be left."""
    if run.t.size < max(lead + tail + 1, 5) or (plan.chain.derivative == "savitzky-golay" and run.t.size < 2 * plan.exact + 1):
        return None
    q, qd, qdd = _motion(run, plan)
    if not plan.chain.parallel and plan.thinning > 1:
        n = plan.thinning
        return run.t[::n], *(decimate_chebyshev(x, n) for x in (q, qd, qdd, run.tau)), run.tau[::n]  # type: ignore[return-value]
    if plan.anti_alias is None:
        kept = slice(lead, run.t.size - tail)
        return run.t[kept], q[kept], qd[kept], qdd[kept], run.tau[kept], run.tau[kept]
    m = plan.anti_alias.margin
    first, last = max(lead, m), run.t.size - max(tail, m)
    if first >= last:
        return None
    tau = plan.anti_alias.apply(run.tau[first - m : last + m], axis=0)
    kept = slice(first, last, plan.thinning)
    return run.t[kept], q[kept], qd[kept], qdd[kept], tau, run.tau[kept]


def _assembled(recording: Recording, plan: _Plan, pieces: list[Piece], provenance: tuple[str, ...]) -> Samples:
    stops = np.cumsum([piece[0].size for piece in pieces]).tolist()
    t, q, qd, qdd, tau, tau_raw = (np.concatenate(parts) if len(pieces) > 1 else parts[0] for parts in zip(*pieces, strict=True))
    return Samples(
        t=t,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=tau,
        tau_raw=tau_raw,
        rate=plan.rate / plan.thinning,
        joint_names=recording.joint_names,
        segments=tuple(zip([0, *stops[:-1]], stops, strict=True)),
        source=recording.source,
        torque_source=recording.torque_source,
        parallel=plan.parallel,
        provenance=provenance,
    )


def _described(plan: _Plan, lost: int) -> Iterator[str]:
    chain = plan.chain
    if chain.derivative == "central":
        double = "of both passes" if chain.corrected else "of each pass"
        yield f"positions: Butterworth of order {chain.order} forwards and backwards, -3 dB {double} at {chain.cutoff:.3g} Hz of {plan.rate:g} Hz; central differences"
    else:
        yield f"positions and derivatives: {chain.derivative}, -3 dB at {chain.cutoff:.3g} Hz of {plan.rate:g} Hz"
    if chain.velocity == "measured":
        yield "velocities: as logged, through the same low-pass; accelerations from them"
    if plan.margin:
        yield f"{plan.margin} samples ({plan.margin / plan.rate:.2g} s) trimmed at either end of every run, where the low-pass has not settled"
    if lost:
        yield f"{lost} runs too short for the filters were dropped"
    if plan.anti_alias is not None:
        yield f"thinned by {plan.thinning} to {plan.rate / plan.thinning:g} Hz, the torque through an anti-aliasing filter"
    if plan.parallel is not None:
        yield (
            f"torque and every regressor column: the same zero-phase low-pass, -3 dB at {plan.parallel.cutoff:.3g} Hz, then every {plan.parallel.decimation}th "
            f"sample ({plan.parallel.output_rate:.3g} Hz)"
        )
    elif plan.thinning > 1:
        yield f"everything decimated by {plan.thinning} with a Chebyshev type I filter of order 8 forwards and backwards"
