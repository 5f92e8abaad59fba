"""Largest error of velocities, from recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.monitoring.causal_filter import SETTLED, CausalFilter

LARGEST = 3.0
"""Errors of a sample, in standard deviations, that count as the largest."""
ORDER = 4
"""Order of the differences in which noise shows and motion does not."""
GAIN = float(np.sqrt(70.0))
"""Standard deviation of fourth differences of white noise of 1: root of 1 + 16 + 36 + 16 + 1."""
SLOWEST = 0.1
"""Share of the samples, the slowest, in which noise is sought."""


def largest_velocity_error(
    logs: Sequence[tuple[Array, Array, Array | None]], pole: float | None = None
) -> Array:
    """Return the largest error (n,) of velocities [rad/s or m/s]: three standard deviations.

    Noise is that of fourth differences (their median size, without those that are 0), in which
    motion within the bandwidth of a robot hardly shows. It is taken from the slowest tenth of the
    samples: where direction may be unknown, and where an irregular clock makes no noise.

    Parameters
    ----------
    logs
        Times (N,) [s], positions and velocities (N, n); the largest noise of the logs counts.
    pole
        Pole [rad/s] of the causal filter that makes velocities of positions; None: logged
        velocities are used.

    Examples
    --------
    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> noisy = np.cos(t) + 1e-3 * np.random.default_rng(0).normal(size=t.shape)
    >>> largest_velocity_error([(t, np.sin(t)[:, None], noisy[:, None])]).round(3).tolist()
    [0.003]
    """
    found = []
    for t, q, qd in logs:
        kept = np.isfinite(t) & np.isfinite(q).all(axis=1)
        if pole is not None:
            x = q[kept]
            found.append(
                _noise(x, x[ORDER:] - x[:-ORDER])
                * _derivative_gain(pole, float(np.median(np.diff(t))))
            )
        elif qd is not None:
            x = qd[kept & np.isfinite(qd).all(axis=1)]
            found.append(_noise(x, x[ORDER:] + x[:-ORDER]))
    return np.asarray(LARGEST * np.max(found, axis=0))


def _noise(x: Array, rate: Array) -> Array:
    """Return the standard deviation (n,) of white noise in columns (N, n) where `rate` is least."""
    sizes, found = np.abs(np.diff(x, ORDER, axis=0)), []
    for size, speed in zip(sizes.T, np.abs(rate).T, strict=True):
        near = size[speed <= np.quantile(speed, SLOWEST)] if size.size else size
        found.append(np.median(near[near > 0.0]) if near.any() else 0.0)
    # Median of the absolute value of a standard normal variable.
    return np.array(found) / (0.6745 * GAIN)


def _derivative_gain(pole: float, spacing: float) -> float:
    """Return the standard deviation of the filter's derivative per that of white noise."""
    running, total = CausalFilter(pole), 0.0
    running.start(np.zeros(1))
    running.age = SETTLED / pole
    for k in range(1 + int(np.ceil(2.0 * SETTLED / (pole * spacing)))):
        total += float(running.update(spacing, np.ones(1) * (k == 0))[1][0]) ** 2
    return float(np.sqrt(total))
