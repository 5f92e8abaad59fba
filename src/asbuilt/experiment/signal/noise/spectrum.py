"""Power spectra by averaged periodograms."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import fft
from scipy.signal import get_window

from asbuilt.arrays import Array


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
    weights = get_window(window, length)
    parts = sliding_window_view(np.ascontiguousarray(x.T), length, axis=-1)
    parts = parts[:, :: length - length // 2]
    if centred:
        parts = parts - parts.mean(axis=-1, keepdims=True)
    transform = fft.rfft(parts * weights, axis=-1)
    power = np.mean(transform.real**2 + transform.imag**2, axis=1) / (rate * np.sum(weights**2))
    power[:, 1 : (length + 1) // 2] *= 2.0
    return np.asarray(power.T, dtype=np.float64)
