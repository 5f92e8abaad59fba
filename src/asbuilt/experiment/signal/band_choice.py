"""Power spectra, and the default cutoff: what the motion asks for, less what noise takes.

A motion whose position has the spectrum S takes the torque I^2 w^4 S for its acceleration alone.
Where the measured torque has less, the difference is noise of the positions: steps of an encoder,
digits of a file, jitter of a clock. A low-pass at c leaves the noise below c in the regressor, and
loses the torque above c that the model could predict. Both are squared errors of the predicted
torque; the cutoff keeps their sum small, as a Wiener filter does (Wiener, Extrapolation,
Interpolation, and Smoothing of Stationary Time Series, 1949).

A base that floats has no torque to compare with. The noise of its pose is white, as high as the
spectrum is where no body moves, and its errors are errors of the acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.experiment.signal.resampling import UniformSegment

LOWEST = 3.0
"""Lowest cutoff [Hz] that noise leads to: friction changes sign within a fraction of a second."""
NOISE_FROM = 0.3
"""Share of the sampling rate from which the torque, or the pose of a base, is noise."""
SMOOTHED = 11
ABOVE_NOISE = 4.0
"""Number of bins over which the spectrum of a motion is smoothed, and multiple of the noise that it
then exceeds where a joint or a base moves."""
MODEL_ERROR = 0.02
"""Smallest error of a model, as a share of the torque's standard deviation."""


@dataclass(frozen=True, eq=False)
class NoiseLimit:
    """Hold the expected errors of cutoffs, and the noise of the positions.

    Parameters
    ----------
    frequency
        Frequencies [Hz], shape (F,).
    error
        Expected squared error of the torque with a low-pass there, relative to that with an ideal
        one, shape (F, n).
    noise
        Spectrum of the positions that the torque does not account for [rad^2/Hz], shape (F, n).
    """

    frequency: Array
    error: Array
    noise: Array

    def cutoff(self, usual: float) -> float:
        """Return the highest cutoff up to `usual` [Hz] whose expected error is as good as the best.

        The error is the geometric mean over joints, so that each counts by its own relative change
        and none decides for all.
        """
        tried = (self.frequency >= LOWEST) & (self.frequency < usual)
        if not tried.any():
            return usual
        at = np.flatnonzero(tried)
        # The error at `usual` itself is compared too, by the next frequency.
        at = np.append(at, min(int(at[-1]) + 1, self.frequency.size - 1))
        # Mean of logarithms: the geometric mean over joints.
        mean = np.mean(np.log(self.error[at]), axis=1)
        # An error of 1.02 times the smallest counts as equally good.
        good = at[mean <= mean.min() + 2.0 * np.log(1.02)]
        # As good at the end as anywhere: noise asks for no lower cutoff.
        return usual if good[-1] == at[-1] else float(self.frequency[good[-1]])

    def limiting_joint(self, usual: float) -> int:
        """Return the joint whose expected error grows most up to `usual` [Hz]."""
        last = min(int(np.searchsorted(self.frequency, usual)), self.frequency.size - 1)
        first = min(int(np.searchsorted(self.frequency, LOWEST)), last)
        return int(np.argmax(self.error[last] / self.error[first : last + 1].min(axis=0)))

    def density(self, cutoff: float) -> Array:
        """Return the noise of the positions about a cutoff [Hz], a spectrum [rad^2/Hz], (n,)."""
        # About the cutoff, where the noise that is left has most of its acceleration.
        near = (self.frequency >= 0.7 * cutoff) & (self.frequency <= 2.0 * cutoff)
        return np.asarray(
            np.median(self.noise[near], axis=0) if near.any() else 0.0 * self.noise[0],
            dtype=np.float64,
        )


def estimate_noise_limit(
    segments: Sequence[tuple[Array, Array]], rate: float, *, of_velocity: bool = False
) -> NoiseLimit | None:
    """Return the errors that a cutoff leaves, from positions and torques (L, n) of each segment.

    Parameters
    ----------
    segments
        Positions (or velocities) and torques, at one uniform `rate` [Hz].
    rate
        Sampling rate [Hz].
    of_velocity
        Whether velocities are given and differentiated, in place of positions.

    Returns
    -------
    NoiseLimit or None
        None if no segment lasts two periods of the lowest cutoff, or nothing moves.
    """
    # Spectra are averaged over windows of 10 s.
    window = min(round(10.0 * rate), max(q.shape[0] for q, _ in segments))
    # Too short to resolve the lowest cutoff, or too slow to show noise above it.
    if window < 2 * rate / LOWEST or rate < 4.0 * LOWEST:
        return None
    frequency = np.asarray(np.fft.rfftfreq(window, 1.0 / rate), dtype=np.float64)
    position, torque = (
        # Side lobes of 92 dB: the motion would cover the noise at high frequencies otherwise.
        _estimate_spectrum(list(signals), rate, window, window="blackmanharris")
        for signals in zip(*segments, strict=True)
    )
    w = 2.0 * np.pi * frequency[:, None]
    if of_velocity:
        # A position has the spectrum of its velocity over w^2.
        position = np.divide(position, w**2, out=np.zeros_like(position), where=w > 0.0)
    # w^4 S, the spectrum of the acceleration.
    acceleration = w**4 * position
    inertia = _estimate_squared_inertia(frequency, position, acceleration, torque)
    white = np.median(position[frequency > NOISE_FROM * rate], axis=0)
    # Smoothed, since single bins of a spectrum scatter by their own size.
    clear = _smooth(position, "symmetric") > ABOVE_NOISE * white
    # Of joints without any torque: those of a base that floats.
    free = clear[frequency >= LOWEST].any(axis=0) & ~torque.any(axis=0)
    torque = np.where(free, clear * np.clip(acceleration - w**4 * white, 0.0, None), torque)
    # Errors of a base are errors of its acceleration: an inertia of one.
    inertia = np.where(free, 1.0, inertia)
    if not np.any(inertia > 0.0):
        return None
    # What the acceleration would take beyond the torque that was measured is noise.
    excess = np.clip(inertia * acceleration - torque, 0.0, None) * (frequency >= LOWEST)[:, None]
    share = np.divide(
        excess, inertia * acceleration, out=np.zeros_like(excess), where=acceleration * inertia > 0
    )
    return NoiseLimit(
        frequency,
        _predict_errors(frequency, torque, excess, [tau for _, tau in segments], rate),
        share * position,
    )


def _estimate_spectrum(parts: Sequence[Array], rate: float, length: int, **how: Any) -> Array:
    """Return the `power_density` (F, n) of the segments that are as long as its windows."""
    long_enough = [x for x in parts if len(x) >= length]
    spectra = [len(x) * power_density(x, rate, length, **how) for x in long_enough]
    return np.asarray(sum(spectra) / sum(map(len, long_enough)))


def _estimate_squared_inertia(
    frequency: Array, position: Array, acceleration: Array, torque: Array
) -> Array:
    """Return torque over acceleration, squared (n,), at frequencies of the motion."""
    # Noise is the median of twelve bands, equally wide in log frequency.
    edges = np.geomspace(1.0, frequency[-1], 12 + 1)
    bands = [(frequency >= a) & (frequency < b) for a, b in pairwise(edges)]
    noise = np.median([np.median(position[band], axis=0) for band in bands if band.any()], axis=0)
    velocity = (2.0 * np.pi * frequency[:, None]) ** 2 * position
    # Frequencies of the motion: far above the noise of the position, and within these shares of the
    # largest velocity and acceleration.
    clear = position > 100.0 * noise
    clear &= velocity > 1e-3 * velocity.max(axis=0)
    clear = np.where(clear, acceleration, 0.0)
    moving = (clear > 0.02 * clear.max(axis=0)) & (clear > 0.0)
    squares = np.zeros(position.shape[1])
    for k in np.flatnonzero(moving.any(axis=0)):
        at = moving[:, k]
        # Gravity, friction and other joints add torque at some frequencies.
        squares[k] = np.quantile(torque[at, k] / acceleration[at, k], 0.25)
    return squares


def _predict_errors(
    frequency: Array, torque: Array, excess: Array, logged: Sequence[Array], rate: float
) -> Array:
    """Return the squared error with a low-pass at each frequency relative to an ideal one."""
    above = (frequency >= LOWEST)[:, None]
    width = float(frequency[1])
    floor = np.median(torque[frequency > NOISE_FROM * rate], axis=0)
    useful = np.clip(torque - floor, 0.0, None) * above
    # What a low-pass at each frequency takes away, and what it leaves of the noise.
    lost = (useful.sum(axis=0) - np.cumsum(useful, axis=0)) * width
    power = np.maximum(
        (torque * above).sum(axis=0) * width,
        # Above its floor the torque is signal.
        MODEL_ERROR**2 * np.mean([tau.var(axis=0) for tau in logged], axis=0),
    )
    power = np.maximum(power, np.finfo(np.float64).tiny)
    rest = np.maximum(power - useful.sum(axis=0) * width, 0.0)
    errors = (rest + lost + np.cumsum(excess, axis=0) * width) / power
    # No model is exact: below its error a cutoff gains nothing.
    return np.asarray(np.maximum(errors, MODEL_ERROR**2), dtype=np.float64)


WINDOW = 20.0
"""Length of the windows [s] over which spectra of a motion are averaged; their resolution is its
inverse."""


def motion_bandwidth(segments: Sequence[Array], rate: float) -> float:
    """Return the frequency [Hz] below which 95 % of the fastest joint's velocity power lies.

    `segments` are position arrays (L, n) at one uniform `rate` [Hz]. The velocity's spectrum is (2
    pi f)^2 times the position's (Welch, IEEE Trans. Audio and Electroacoustics, 1967). Joints
    slower than a hundredth of the fastest do not count. White noise of the positions is estimated
    from the upper half of the spectrum; bins beyond the motion that it dominates do not count.
    """
    # Of differences, whose spectrum falls with the frequency: a position's leaks from its drift.
    velocities = [np.diff(q, axis=0) * rate for q in segments]
    window = min(round(WINDOW * rate), max(map(len, velocities)))
    frequency = np.fft.rfftfreq(window, 1.0 / rate)
    total = _estimate_spectrum(velocities, rate, window, centred=False)
    total[_mark_noise_bins(total, np.asarray(frequency / rate, dtype=np.float64))] = 0.0
    power = total.sum(axis=0)
    # A hundredth of the speed is a ten thousandth of the power.
    moving = power > 1e-4 * power.max()
    if not moving.any():
        return 1.0 / WINDOW
    share = np.cumsum(total[:, moving], axis=0) / power[moving]
    reached = (share >= 0.95).argmax(axis=0)
    # The fastest joint decides, as all are filtered alike.
    return float(max(frequency[reached.max()], 1.0 / WINDOW))


def _smooth(spectra: Array, ends: Literal["symmetric", "edge"]) -> Array:
    """Return the mean of spectra (F, n) over `SMOOTHED` bins, continued at the ends."""
    half = SMOOTHED // 2
    continued = np.pad(spectra, ((half, half), (0, 0)), ends)
    return np.asarray(sliding_window_view(continued, SMOOTHED, axis=0).mean(axis=-1))


def _mark_noise_bins(total: Array, cycles: Array) -> NDArray[np.bool_]:
    """Return which bins (F, n) of velocity spectra are noise; `cycles` (F,) are per sample."""
    # White positions, differenced: a spectrum of sin^2.
    shape = np.sin(np.pi * cycles)[:, None] ** 2
    upper = cycles >= 0.25
    noise = shape * (
        total[upper].sum(axis=0) / max(float(shape[upper].sum()), np.finfo(np.float64).tiny)
    )
    # Share of the velocity's power from which white noise of the positions is allowed for.
    noisy = noise.sum(axis=0) > 0.01 * total.sum(axis=0)
    smooth = _smooth(total, "edge")
    # The last bin that stands out of the noise; beyond it nothing is motion.
    last = np.where(smooth > ABOVE_NOISE * noise, np.arange(len(cycles))[:, None], 0).max(axis=0)
    return np.asarray(noisy & (np.arange(len(cycles))[:, None] > last))


POSITION_BANDWIDTHS = 10.0
"""Default position cutoff, in bandwidths of the motion."""
LOWEST_CUTOFF = 7.0
"""Lowest default cutoff [Hz] where noise of the positions does not demand a lower one.

Friction changes sign within a tenth of a second. Tuned on recordings of UR10e, LWR4+, Med 7,
AIRBOT, Rokae and TX40; none was kept apart to test it.
"""
HIGHEST_SHARE = 0.2
HIGHEST_SHARE_LOGGED = 0.4
"""Highest default cutoff, as a share of the sampling rate; beyond the first central differences
take a quarter and more of the rates. The second holds where accelerations are logged, which nothing
differences.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Hold the bandwidth of a motion, the cutoff for it, and the one that noise leaves, in Hz.

    `noise` is None for a recording too short for its spectra.
    """

    bandwidth: float
    wanted: float
    cutoff: float
    noise: NoiseLimit | None

    def __str__(self) -> str:
        by_noise = f"; noise in the log limits the band, wanted were {self.wanted:.3g} Hz"
        return (
            f"95 % of the velocity's power lies below {self.bandwidth:.3g} Hz; positions are kept"
            f" up to {self.cutoff:.3g} Hz{by_noise if self.cutoff < self.wanted else ''}"
        )


def choose_band(
    segments: Sequence[UniformSegment],
    rate: float,
    *,
    of_velocity: bool = False,
    computed: bool = False,
) -> Band:
    """Return the default cutoff of segments at one rate [Hz].

    A torque that is `computed` from the positions contains their noise, so that it is no measure
    of it: noise then demands no cutoff below `LOWEST_CUTOFF`. A lower one turns the phase by which
    stiffness and delay of the drive are found. With `of_velocity` the noise is in the logged
    velocities, from which accelerations follow.
    """
    moved = [
        # Velocities are summed to positions, so that one rule serves both.
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
    if computed:
        # Below it the phase that shows stiffness and delay would turn.
        cutoff = max(cutoff, min(wanted, LOWEST_CUTOFF))
    return Band(bandwidth, wanted, cutoff, noise)


WINDOWS = {"hann": (0.5, 0.5), "blackmanharris": (0.35875, 0.48829, 0.14128, 0.01168)}
"""Weights of the cosines that a window sums (Harris, Proc. IEEE 66, 1978)."""
SAMPLES_AT_ONCE = 500_000
"""Samples whose windows are transformed together: 4 MB, and the transforms six times as much."""


def power_density(
    x: Array, rate: float, length: int, *, window: str = "hann", centred: bool = True
) -> Array:
    """Return the one-sided power spectral density of the columns of x (L, n), (length // 2 + 1, n).

    Periodograms of windows that overlap by half are averaged (Welch, IEEE Trans. Audio and
    Electroacoustics, 1967); `centred` windows have their mean taken out. The density is per Hz, at
    the frequencies `np.fft.rfftfreq(length, 1 / rate)`.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(size=(20_000, 1))
    >>> float(power_density(noise, 100.0, 200).sum() * 0.5).__round__(1)
    1.0
    """
    # Periodic window: the sample after the last would be the first.
    phase = np.linspace(-np.pi, np.pi, length + 1)[:-1]
    weights = sum(a * np.cos(k * phase) for k, a in enumerate(WINDOWS[window]))
    parts = sliding_window_view(np.ascontiguousarray(x.T), length, axis=-1)
    # Windows overlap by half.
    parts = parts[:, :: length - length // 2]
    power = np.zeros((x.shape[1], length // 2 + 1))
    at_once = max(1, SAMPLES_AT_ONCE // (x.shape[1] * length))
    for first in range(0, parts.shape[1], at_once):
        some = parts[:, first : first + at_once]
        if centred:
            some = some - some.mean(axis=-1, keepdims=True)
        transform = np.fft.rfft(some * weights, axis=-1)
        power += np.sum(transform.real**2 + transform.imag**2, axis=1)
    power /= parts.shape[1] * rate * np.sum(weights**2)
    # One-sided: all but the mean, and half the rate where there is one, stand for two.
    power[:, 1 : (length + 1) // 2] *= 2.0
    return np.asarray(power.T, dtype=np.float64)
