"""Filter plan: filters, decimation and margins of a signal chain at one sampling rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, find_finite_rows
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.band_choice import power_density
from asbuilt.experiment.signal.differentiation import (
    PAUSE,
    central_differences,
    find_moving_ranges,
    find_rests,
    savitzky_golay,
    savitzky_golay_window,
    smoothing_spline,
)
from asbuilt.experiment.signal.lowpass import (
    HALF_WIDTH,
    butterworth,
    decimate_chebyshev,
    gaussian,
    kernel_samples,
    settling_samples,
    shift_in_time,
)
from asbuilt.experiment.signal.parallel_filter import (
    STOP_BAND_EDGE,
    ParallelFilter,
    design_parallel_filter,
)
from asbuilt.experiment.signal.resampling import UniformSegment
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Cure

SegmentArrays = tuple[Array, Array, Array, Array, Array, Array]
"""t, q, qd, qdd, tau and the torque as recorded, of one segment."""
FilteredMotion = tuple[Array, Array, Array]
"""q, qd, qdd (L, n) of a segment at the logged rate, low-passed."""


DIFFERENCES = 2
"""Samples to either side that an acceleration takes by central differences of velocities."""
SPECTRUM = 256
"""Samples of the spectra whose upper quarter shows the noise of a pose."""


@dataclass(frozen=True, slots=True)
class FilterPlan:
    """Hold the filters of a chain whose cutoff is known, for logs at `rate` [Hz].

    `cutoff` [Hz] is the chain's. `thinning` logged samples make one of `Samples`; the torque passes
    `anti_alias` before that, and `parallel` remains to be applied. `margin` logged samples are
    trimmed at either end of a segment; `exact` of them depend on the ends at all.
    """

    chain: SignalChain
    cutoff: float
    rate: float
    thinning: int
    anti_alias: ParallelFilter | None
    parallel: ParallelFilter | None
    margin: int
    exact: int

    @classmethod
    def of(cls, chain: SignalChain, rate: float) -> FilterPlan:
        """Return the plan of a chain at a rate [Hz].

        Raises
        ------
        UsageError
            If the chain has no cutoff yet, or its cutoffs and decimation do not fit the rate.
        """
        cutoff = chain.cutoff
        total = chain.decimate
        if cutoff is None:
            raise UsageError(
                "the signal chain has no cutoff",
                cure=Cure(
                    "give one, or choose it from a recording", call="experiment.resolve_chain"
                ),
            )
        if chain.derivative == "savitzky-golay":
            # Half a window: its polynomial needs samples on both sides.
            margin = exact = savitzky_golay_window(cutoff, rate) // 2
        elif chain.derivative == "gaussian":
            # The kernel ends, and so do the differences after it.
            margin = exact = kernel_samples(cutoff, rate) + DIFFERENCES
        else:
            # Of the response of the low-pass, 1e-12 of its peak counts as zero.
            margin, exact = (
                settling_samples(
                    cutoff, rate, order=chain.order, corrected=chain.corrected, tolerance=tolerance
                )
                for tolerance in (0.01, 1e-12)
            )
        # Untrimmed chains keep the transients, as published ones do.
        margin = margin if chain.trimmed else 0
        if not chain.parallel:
            return cls(chain, cutoff, rate, total or 1, None, None, margin, exact)
        # At half its cutoff the low-pass of the positions, which the torque does not pass, is
        # within 0.2 % of 1; at its own cutoff it takes 30 % of the accelerations, and inertias
        # would grow by as much to make up. Below 3 Hz friction and rests of the motion go.
        low = chain.parallel_cutoff or min(
            max(0.5 * cutoff, min(3.0, cutoff)), 0.5 * rate / STOP_BAND_EDGE
        )
        # Logs are thinned to 100 Hz at least, and to 12 cutoffs of the positions.
        thinning = max(1, int(rate / max(100.0, 12.0 * cutoff) + 1e-9))
        if total is not None:
            # The whole decimation must be a product of thinning and the parallel filter's.
            thinning = max(factor for factor in range(1, thinning + 1) if total % factor == 0)
            factor = total // thinning
            if chain.parallel_cutoff is None:
                # A default cutoff gives way to what the wanted rate can carry.
                low = min(low, 0.5 * rate / total / STOP_BAND_EDGE)
        else:
            factor = max(1, int(rate / thinning / (4.0 * low)))
        anti_alias = (
            # A quarter of the thinned rate: no aliases reach the band that is kept.
            design_parallel_filter(0.25 * rate / thinning, rate, thinning) if thinning > 1 else None
        )
        parallel = design_parallel_filter(low, rate / thinning, factor)
        return cls(chain, cutoff, rate, thinning, anti_alias, parallel, margin, exact)

    @property
    def support(self) -> int:
        """Number of logged samples on either side that a prepared sample depends on."""
        smear = self.anti_alias.margin if self.anti_alias else 0
        shift = max(self.late) + HALF_WIDTH if self.chain.delays else 0
        # A rest is recognised by what lies within a pause on either side.
        rest = 0 if self.chain.rests else int(np.ceil(PAUSE * self.rate)) + self.shoulder
        return max(self.exact, smear + shift) + rest + 2

    @property
    def late(self) -> tuple[int, int]:
        """Number of samples at the beginning and at the end whose shifted torque was not logged."""
        shifts = [delay * self.rate for delay in (*self.chain.delays, 0.0)]
        # A torque that is late by d needs samples from d later on.
        return int(np.ceil(-min(shifts))), int(np.ceil(max(shifts)))

    @property
    def shoulder(self) -> int:
        """Number of logged samples on either side that an output of the parallel filter takes."""
        return self.parallel.margin * self.thinning if self.parallel else 0

    def motion(self, segment: UniformSegment) -> FilteredMotion:
        """Return q, qd, qdd (L, n) of a segment at the logged rate, low-passed."""
        chain = self.chain
        rate = self.rate
        smooth = self.smooth
        cutoff = self.cutoff
        if chain.derivative == "savitzky-golay":
            q, qd, qdd = savitzky_golay(segment.q, rate, cutoff=cutoff)
        elif chain.derivative == "spline":
            q, qd, qdd = smoothing_spline(segment.q, rate, cutoff=cutoff)
        else:
            q = smooth(segment.q)
            qd = central_differences(q, rate)
            qdd = central_differences(qd, rate)
        if chain.velocity == "measured" and segment.qd is not None:
            qd = smooth(segment.qd)
            # Logged accelerations are no differences of ours, and stay.
            qdd = central_differences(qd, rate) if segment.qdd is None else smooth(segment.qdd)
        return q, qd, qdd

    def smooth(self, x: Array) -> Array:
        """Return columns of x (L, n) after the low-pass of the positions."""
        chain = self.chain
        cutoff = self.cutoff
        if chain.derivative == "gaussian":
            # With the differences that follow the response ends at half a period.
            differences = 0 if chain.velocity == "measured" else DIFFERENCES
            return gaussian(x, cutoff=cutoff, rate=self.rate, shorter=differences)
        return butterworth(
            x, cutoff=cutoff, rate=self.rate, order=chain.order, corrected=chain.corrected
        )

    def pose_noise(self, q: Array) -> tuple[float, ...]:
        """Return the variance of each filtered acceleration by white noise of positions q (N, n).

        Empty where rates are logged, whose noise is another.
        """
        q = q[find_finite_rows(q)]
        if self.chain.velocity == "measured" or self.parallel is None or len(q) < SPECTRUM:
            return ()
        # An impulse through everything that acts on positions: its squares sum to the noise gain.
        reach = self.exact + DIFFERENCES + 1
        n = self.thinning
        impulse = np.zeros(2 * reach + 1)
        impulse[reach] = 1.0
        # Two differences make accelerations of positions.
        twice = central_differences(central_differences(self.smooth(impulse), self.rate), self.rate)
        taps = np.zeros(n * (self.parallel.taps.size - 1) + 1)
        # The parallel filter works on thinned samples: its taps lie so far apart.
        taps[::n] = self.parallel.taps
        power = power_density(q, 2.0, SPECTRUM)
        noise = np.median(power[-SPECTRUM // 8 :], axis=0)  # the upper quarter of the band
        # White noise through taps h has the variance sum h^2.
        return tuple((noise * np.sum(np.convolve(twice, taps) ** 2)).tolist())

    def fits(self, segment: UniformSegment) -> bool:
        """Return whether a segment is long enough to be filtered and differentiated."""
        return segment.t.size >= (
            2 * self.exact + 1
            if self.chain.derivative == "savitzky-golay"
            else max(2 * self.margin + 1, 5)
        )

    def cut(
        self, segment: UniformSegment, motion: FilteredMotion, low: int, stop: int
    ) -> tuple[list[SegmentArrays], int]:
        """Return what is left of a segment between logged samples, and where a longer one goes on.

        `motion` belongs to the segment, whose torque is shifted back by the delay. The samples are
        those from `low` to before `stop` whose torque was logged. Continued from the index
        returned, the filtered samples of the whole segment appear once each.

        Raises
        ------
        UsageError
            If delays are of another number of joints.
        """
        q, qd, qdd = motion
        tau = self._advance(segment.tau)
        if self.chain.derivative == "gaussian":  # not flat in the band, so for both sides alike
            tau = self.smooth(tau)
        n = self.thinning
        speeds = self.chain.standstill
        first = self.late[0]
        last = segment.t.size - self.late[1]
        if first >= last:
            # The shift leaves nothing that was logged.
            return [], stop
        if not self.chain.parallel and n > 1:
            t, q, qd, qdd, tau = (x[first:last] for x in (segment.t, q, qd, qdd, tau))
            q, qd, qdd, smooth = (decimate_chebyshev(x, n) for x in (q, qd, qdd, tau))
            return [(t[::n], q, qd, qdd, smooth, tau[::n])], segment.t.size
        ranges = [(0, segment.t.size)]
        if not self.chain.rests and speeds is not None:
            still = find_rests(qd, speeds, self.rate)
            if still.any():
                # At rest filters leave creeping velocities, whose sign friction would follow.
                qd = np.where(still, 0.0, qd)
                qdd = np.where(still, 0.0, qdd)
            ranges = find_moving_ranges(still, self.rate, self.shoulder)
        m = self.anti_alias.margin if self.anti_alias else 0
        parts = []
        after = stop
        for begin, end in ranges:
            # Where torques were shifted in, or the anti-alias has no input, nothing is kept.
            a = max(begin, low, first + m)
            b = min(end, stop, last - m)
            if a >= b:
                continue
            kept = slice(a, b, n)
            smooth = tau[kept]
            if self.anti_alias:
                smooth = self.anti_alias.apply(tau[a - m : b + m], axis=0)
            parts.append((segment.t[kept], q[kept], qd[kept], qdd[kept], smooth, tau[kept]))
            # The last range may go on in the next chunk: where its outputs end is where that
            # begins.
            if end >= stop:
                outputs, step = (
                    (self.parallel.n_outputs(len(smooth)), self.parallel.decimation)
                    if self.parallel
                    else (len(smooth), 1)
                )
                after = a + outputs * step * self.thinning
        return parts, after

    def _advance(self, tau: Array) -> Array:
        """Return torques (L, n) shifted back by the known delay of the chain."""
        delays = self.chain.delays
        n = tau.shape[1]
        if len(delays) not in (0, 1, n):
            raise UsageError(
                f"a delay is one number for all joints or one for each of {n}, got {len(delays)}"
            )
        return shift_in_time(tau, np.broadcast_to(delays, n), self.rate) if delays else tau

    def describe(self) -> Iterator[str]:
        """Yield sentences about what the plan does."""
        chain = self.chain
        cutoff = self.cutoff
        if chain.derivative == "central":
            passes = "of both passes" if chain.corrected else "of each pass"
            yield (
                f"positions: Butterworth of order {chain.order} forwards and backwards, -3 dB"
                f" {passes} at {cutoff:.3g} Hz of {self.rate:g} Hz; velocities and accelerations by"
                " central differences"
            )
        else:
            yield (
                f"positions, velocities and accelerations: {chain.derivative}, -3 dB at"
                f" {cutoff:.3g} Hz of {self.rate:g} Hz"
            )
        if chain.velocity == "measured":
            yield "velocities: as logged, through the same low-pass; accelerations from them"
        if chain.delays:
            listed = ", ".join(f"{1e3 * delay:.3g}" for delay in chain.delays)
            yield f"torque: shifted back by a delay of {listed} ms"
        if self.margin:
            yield (
                f"{self.margin} samples ({self.margin / self.rate:.2g} s) trimmed at either end of"
                " every segment, where the low-pass has not settled"
            )
        if self.anti_alias is not None:
            yield (
                f"thinned by {self.thinning} to {self.rate / self.thinning:g} Hz, the torque"
                " through an anti-aliasing filter"
            )
        if self.parallel is not None:
            yield (
                "torque and every regressor column: the same zero-phase low-pass, -3 dB at"
                f" {self.parallel.cutoff:.3g} Hz, then one sample in {self.parallel.decimation}"
                f" ({self.parallel.output_rate:.3g} Hz)"
            )
        elif self.thinning > 1:
            yield (
                f"everything decimated by {self.thinning} with a Chebyshev type I filter of order 8"
                " forwards and backwards"
            )
