"""Analysis of torque errors: whiteness, effective samples, spectrum, velocity."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from asbuilt.arrays import Array
from asbuilt.experiment.signal.band_choice import power_density

Segments = tuple[tuple[int, int], ...]


# Configure the analysis; own choices but for the lags (Ljung and Box, 1978).

RESIDUAL_LONGEST_LAG = 2.0  # Lag up to which autocorrelation is evaluated [s]
RESIDUAL_LJUNG_BOX_LAGS = 20  # Lags of the test of Ljung and Box, if there are as many
# A time step of this many median steps, or one that does not advance, ends a segment
RESIDUAL_GAP = 1.5
RESIDUAL_WINDOW = 1024  # Samples of a window of Welch's spectrum


def find_contiguous_segments(t: Array) -> Segments:
    """Return the (start, stop) index ranges of `t` (N,) between which time jumps.

    >>> find_contiguous_segments(np.array([0.0, 0.1, 0.2, 1.0, 1.1, 0.0]))
    ((0, 3), (3, 5), (5, 6))
    """
    steps = np.diff(t)
    forward = steps[steps > 0]
    # Steps that do not advance end a segment as gaps do.
    limit = RESIDUAL_GAP * float(np.median(forward)) if len(forward) else np.inf
    cuts = np.flatnonzero((steps <= 0) | (steps > limit)) + 1
    return tuple(pairwise([0, *cuts.tolist(), len(t)])) if len(t) else ()


def autocorrelation(residual: Array, segments: Segments, max_lag: int) -> Array:
    """Return the autocorrelation of `residual` (N,) at lags 0..max_lag, shape (max_lag + 1,).

    rho_k = sum_t e_t e_(t+k) / sum_t e_t^2 with the overall mean removed. Pairs never span two
    segments; lags longer than every segment are zero.
    """
    e = residual - residual.mean()
    rho = np.zeros(max_lag + 1)
    energy = float(e @ e)
    # Without an error there is nothing to correlate: white by definition.
    if energy == 0:
        rho[0] = 1.0
        return rho
    for start, stop in segments:
        x = e[start:stop]
        # Twice the length: a circular correlation must not wrap around.
        size = 1 << (2 * len(x) - 1).bit_length()
        lags = min(max_lag + 1, len(x))
        rho[:lags] += np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[:lags]
    return rho / energy


def durbin_watson(residual: Array, segments: Segments) -> float:
    """Return sum (e_t - e_(t-1))^2 / sum e_t^2 (Durbin and Watson, 1950).

    It is 2 for a white residual and near 0 for a slow one.
    """
    energy = float(residual @ residual)
    steps = sum(float(np.sum(np.diff(residual[start:stop]) ** 2)) for start, stop in segments)
    return steps / energy if energy > 0 else float("nan")


def ljung_box(rho: Array, n_samples: int, lags: int) -> tuple[float, float]:
    """Return Q = n (n + 2) sum_k rho_k^2 / (n - k) over lags 1..lags, and its probability.

    A white residual has a larger Q with this probability. Source: Ljung and Box, Biometrika
    65 (1978), equation 1.3.
    """
    # No more lags than there are, and than samples allow.
    k = np.arange(1, min(lags, len(rho) - 1, n_samples - 1) + 1)
    if len(k) == 0:
        return 0.0, 1.0
    q = float(n_samples * (n_samples + 2) * np.sum(rho[k] ** 2 / (n_samples - k)))
    return q, float(chdtrc(len(k), q))


def effective_samples(rho: Array, n_samples: int) -> float:
    """Return n / (1 + 2 sum_k rho_k), summed while neighbouring pairs of lags are positive.

    Source: Geyer, Statistical Science 7 (1992), initial positive sequence.
    """
    usable = len(rho) // 2 * 2
    pairs = rho[:usable].reshape(-1, 2).sum(axis=1)
    # Geyer: sums of neighbouring pairs are positive for a reversible chain; the first other is
    # noise.
    negative = np.flatnonzero(pairs <= 0)
    kept = pairs[: negative[0]] if len(negative) else pairs
    # Between one sample and all of them, whatever the noise of the correlation.
    return float(np.clip(n_samples / max(2.0 * kept.sum() - 1.0, 1.0 / n_samples), 1.0, n_samples))


def measure_whiteness(t: Array, residual: Array, cutoff: float) -> tuple[Array, Array]:
    """Return how white a low-passed `residual` (N, n) is up to `cutoff` [Hz], two arrays (n,).

    Neither depends on the rate at which the residual is sampled, at the times `t` (N,). First,
    Durbin and Watson's statistic between samples half a period of the cutoff apart, `mean (e_t -
    e_(t-1/2f))^2 / mean e_t^2`: 2 for a residual white up to the cutoff, near 0 for a slow one.
    Second, the effective samples as a fraction of the 2 f a second of a white residual.
    """
    segments = find_contiguous_segments(t)
    step = float(np.median(np.diff(t)))
    # Half a period of the cutoff: where white noise behind the low-pass has decorrelated.
    lag = max(1, round(0.5 / (cutoff * step)))
    apart = np.concatenate(
        [
            residual[start + lag : stop] - residual[start : stop - lag]
            for start, stop in segments
            if stop - start > lag
        ]
        or [residual[:0]]
    )
    energy = np.mean(residual**2, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        statistic = (
            np.where(energy > 0, np.mean(apart**2, axis=0), np.nan) / energy
            # Segments too short to hold such a pair leave the statistic open.
            if len(apart)
            else np.full(len(energy), np.nan)
        )
    longest = max(stop - start for start, stop in segments)
    worth = [
        effective_samples(autocorrelation(column, segments, longest - 1), len(t))
        for column in residual.T
    ]
    return statistic, np.minimum(np.array(worth) / (2.0 * cutoff * len(t) * step), 1.0)


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """Describe the torque error of each joint.

    `mean`, `rms`, `durbin_watson`, `ljung_box`, `probability_white`, `effective_samples` have shape
    (n,), `autocorrelation` (lags + 1, n) at `lags` [s], `spectrum` (F, n) [torque^2 / Hz] at
    `frequencies` [Hz].
    """

    joint_names: tuple[str, ...]
    n_samples: int
    lags: Array
    mean: Array
    rms: Array
    durbin_watson: Array
    ljung_box: Array
    probability_white: Array
    effective_samples: Array
    autocorrelation: Array
    frequencies: Array
    spectrum: Array


def analyse_residual(t: Array, residual: Array, joint_names: tuple[str, ...]) -> ResidualAnalysis:
    """Analyse the torque error `residual` (N, n) at times `t` (N,) [s] up to a lag of two seconds.

    Ljung-Box uses at most 20 lags; the spectrum is Welch's, averaged over segments by their length.
    """
    segments = find_contiguous_segments(t)
    longest = max(stop - start for start, stop in segments)
    forward = np.diff(t)[np.diff(t) > 0]
    step = float(np.median(forward)) if len(forward) else 1.0
    n_lags = max(1, min(round(RESIDUAL_LONGEST_LAG / step), longest - 1))
    rho = np.column_stack([autocorrelation(column, segments, n_lags) for column in residual.T])
    tests = [ljung_box(column, len(t), RESIDUAL_LJUNG_BOX_LAGS) for column in rho.T]
    frequencies, spectrum = _estimate_spectrum(residual, segments, 1.0 / step)
    return ResidualAnalysis(
        joint_names=joint_names,
        n_samples=len(t),
        lags=step * np.arange(n_lags + 1, dtype=np.float64),
        mean=residual.mean(axis=0),
        rms=np.sqrt(np.mean(residual**2, axis=0)),
        durbin_watson=np.array([durbin_watson(column, segments) for column in residual.T]),
        ljung_box=np.array([q for q, _ in tests]),
        probability_white=np.array([p for _, p in tests]),
        effective_samples=np.array([effective_samples(column, len(t)) for column in rho.T]),
        autocorrelation=rho,
        frequencies=frequencies,
        spectrum=spectrum,
    )


def _estimate_spectrum(residual: Array, segments: Segments, rate: float) -> tuple[Array, Array]:
    """Return frequencies (F,) and one-sided density (F, n): Welch, Hann windows in each segment."""
    window = min(RESIDUAL_WINDOW, max(stop - start for start, stop in segments))
    total = np.zeros((window // 2 + 1, residual.shape[1]))
    weight = 0
    for start, stop in segments:
        if stop - start >= window:
            # By length, so that long segments count more.
            total += (stop - start) * power_density(residual[start:stop], rate, window)
            weight += stop - start
    frequencies = np.arange(window // 2 + 1, dtype=np.float64) * rate / window
    return frequencies, total / max(weight, 1)


@dataclass(frozen=True, eq=False)
class VelocityCurve:
    """Hold a torque against joint velocity in bins of equal width.

    Centres, quartiles and counts, each (bins,); NaN in bins of under three samples.
    """

    velocity: Array
    lower: Array
    median: Array
    upper: Array
    count: NDArray[np.int64]


def bin_by_velocity(qd: Array, torque: Array, *, bins: int = 40) -> VelocityCurve:
    """Sort `torque` (N,) of a joint by its velocity `qd` (N,) into bins that do not span zero."""
    # A joint that never moves has one bin about zero.
    largest = float(np.max(np.abs(qd), initial=0.0)) or 1.0
    half = max(1, bins // 2)
    # Floor about zero, so that no bin holds both directions of motion.
    index = np.clip(np.floor(qd / largest * half).astype(np.int64), -half, half - 1) + half
    count = np.bincount(index, minlength=2 * half)
    order = np.argsort(index, kind="stable")
    groups = np.split(torque[order], np.cumsum(count)[:-1])
    quartiles = np.array(
        [
            np.percentile(group, [25, 50, 75]) if len(group) >= 3 else [np.nan] * 3
            for group in groups
        ]
    )
    centres = (np.arange(-half, half) + 0.5) * largest / half
    return VelocityCurve(centres, quartiles[:, 0], quartiles[:, 1], quartiles[:, 2], count)
