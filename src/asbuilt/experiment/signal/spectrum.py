"""Power spectra by averaged periodograms."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import fft

from asbuilt.arrays import Array

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
        transform = fft.rfft(some * weights, axis=-1)
        power += np.sum(transform.real**2 + transform.imag**2, axis=1)
    power /= parts.shape[1] * rate * np.sum(weights**2)
    # One-sided: all but the mean, and half the rate where there is one, stand for two.
    power[:, 1 : (length + 1) // 2] *= 2.0
    return np.asarray(power.T, dtype=np.float64)
