"""Default cutoff of the positions: what the motion asks for, less what noise takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from asbuilt.arrays import Array
from asbuilt.experiment.signal.noise.noise_limit import NoiseLimit, estimate_noise_limit
from asbuilt.experiment.signal.noise.spectrum import power_density
from asbuilt.experiment.signal.resampling import UniformSegment


@dataclass(frozen=True, slots=True)
class SpectrumRules:
    """Hold how the bandwidth of a motion is read off its spectrum."""

    velocity_share: float = 0.95
    """Share of the velocity's power that lies below the motion's bandwidth."""
    window: float = 20.0
    """Length of the averaged spectra's windows [s]; their resolution is its inverse."""
    noisy: float = 0.01
    """Share of the velocity's power from which white noise of the positions is allowed for."""
    above_noise: float = 4.0
    """Multiple of the noise's spectrum that the smoothed spectrum of the motion exceeds."""
    smoothed: int = 11
    """Number of bins over which spectra are smoothed."""


RULES = SpectrumRules()


def motion_bandwidth(segments: Sequence[Array], rate: float) -> float:
    """Return the frequency [Hz] below which 95 % of the fastest joint's velocity power lies.

    `segments` are position arrays (L, n) at one uniform `rate` [Hz]. The velocity's spectrum is (2
    pi f)^2 times the position's (Welch, IEEE Trans. Audio and Electroacoustics, 1967). Joints
    slower than a hundredth of the fastest do not count. White noise of the positions is estimated
    from the upper half of the spectrum; bins beyond the motion that it dominates do not count.
    """
    window = min(round(RULES.window * rate), max(q.shape[0] for q in segments) - 1)
    total = np.zeros((window // 2 + 1, segments[0].shape[1]))
    frequency = np.fft.rfftfreq(window, 1.0 / rate)
    for q in segments:
        if q.shape[0] <= window:
            continue
        velocity = np.diff(q, axis=0) * rate
        total += power_density(velocity, rate, window, centred=False) * (q.shape[0] - 1)
    total[_mark_noise_bins(total, np.asarray(frequency / rate, dtype=np.float64))] = 0.0
    power = total.sum(axis=0)
    moving = power > 1e-4 * power.max()
    if not moving.any():
        return 1.0 / RULES.window
    share = np.cumsum(total[:, moving], axis=0) / power[moving]
    reached = (share >= RULES.velocity_share).argmax(axis=0)
    return float(max(frequency[reached.max()], 1.0 / RULES.window))


def _mark_noise_bins(total: Array, cycles: Array) -> NDArray[np.bool_]:
    """Return which bins (F, n) of velocity spectra are noise; `cycles` (F,) are per sample."""
    shape = np.sin(np.pi * cycles)[:, None] ** 2
    upper = cycles >= 0.25
    noise = shape * (
        total[upper].sum(axis=0) / max(float(shape[upper].sum()), np.finfo(np.float64).tiny)
    )
    noisy = noise.sum(axis=0) > RULES.noisy * total.sum(axis=0)
    smooth = uniform_filter1d(total, RULES.smoothed, axis=0, mode="nearest")
    last = np.where(smooth > RULES.above_noise * noise, np.arange(len(cycles))[:, None], 0).max(
        axis=0
    )
    return np.asarray(noisy & (np.arange(len(cycles))[:, None] > last))


POSITION_BANDWIDTHS = 10.0
"""Default position cutoff, in bandwidths of the motion."""
LOWEST_CUTOFF = 7.0
"""Lowest default cutoff [Hz] where noise of the positions does not demand a lower one.

Friction changes sign within a tenth of a second. Tuned on recordings of UR10e, LWR4+, Med 7,
AIRBOT, Rokae and TX40; none was kept apart to test it.
"""
HIGHEST_SHARE = 0.2
"""Highest default cutoff, as a share of the sampling rate; beyond it central differences take a
quarter and more of the rates.
"""
HIGHEST_SHARE_LOGGED = 0.4
"""Likewise where accelerations are logged, which nothing differences."""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Hold the bandwidth of a motion, the cutoff for it, and the one that noise leaves, in Hz.

    `noise` is None for a recording too short for its spectra.
    """

    bandwidth: float
    wanted: float
    cutoff: float
    noise: NoiseLimit | None

    @property
    def limited(self) -> bool:
        """Whether noise of the log limits the band, not the motion."""
        return self.cutoff < self.wanted

    def __str__(self) -> str:
        limited = f"; noise in the log limits the band, wanted were {self.wanted:.3g} Hz"
        return (
            f"95 % of the velocity's power lies below {self.bandwidth:.3g} Hz; positions are kept"
            f" up to {self.cutoff:.3g} Hz{limited if self.limited else ''}"
        )


def choose_band(
    segments: Sequence[UniformSegment],
    rate: float,
    *,
    of_velocity: bool = False,
    commanded: bool = False,
) -> Band:
    """Return the default cutoff of segments at one rate [Hz].

    The torque of a command contains the positions and their noise, so that it is no measure of
    them; if it is `commanded`, noise demands no cutoff below `LOWEST_CUTOFF`. A lower one turns the
    phase by which stiffness and delay of the servo are found. With `of_velocity` the noise is in
    the logged velocities, from which accelerations follow.
    """
    moved = [
        np.cumsum(segment.qd, axis=0) / rate
        if of_velocity and segment.qd is not None
        else segment.q
        for segment in segments
    ]
    bandwidth = motion_bandwidth(moved, rate)
    differenced = not of_velocity or any(segment.qdd is None for segment in segments)
    highest = HIGHEST_SHARE if differenced else HIGHEST_SHARE_LOGGED
    wanted = min(max(POSITION_BANDWIDTHS * bandwidth, LOWEST_CUTOFF), highest * rate)
    logged = [(segment.qd if of_velocity else segment.q, segment.tau) for segment in segments]
    noise = estimate_noise_limit(
        [(x, tau) for x, tau in logged if x is not None], rate, of_velocity=of_velocity
    )
    cutoff = wanted if noise is None else noise.cutoff(wanted)
    if commanded:
        cutoff = max(cutoff, min(wanted, LOWEST_CUTOFF))
    return Band(bandwidth, wanted, cutoff, noise)
