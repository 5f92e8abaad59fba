"""Positions, velocities and torques through one causal filter; error of velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array, Mask, find_finite_rows

SETTLED = 10.0
"""Time in `1 / w` after which the filter has forgotten its start."""


LARGEST = 3.0
"""Errors of a sample, in standard deviations, that count as the largest."""
ORDER = 4
"""Order of the differences in which noise shows and motion does not."""
SLOWEST = 0.1
"""Share of the samples, the slowest, from which noise is estimated."""


class CausalFilter:
    """Filter `x'' = w^2 (u - x) - 2 w x'` sample by sample.

    It is exact for inputs that are linear between samples. The state holds the filtered value and
    its derivative. Torques pass the same filter, so that model and measurement are late by the same
    `2 / w`.

    Parameters
    ----------
    pole
        The double pole w [rad/s].
    """

    def __init__(self, pole: float) -> None:
        self.pole = pole
        self.age = 0.0
        self._input = self._x = self._v = np.empty(0)

    def start(self, u: Array) -> None:
        """Rest at u (m,)."""
        self._input = u
        self._x = u.copy()
        self._v = np.zeros(u.shape)
        self.age = 0.0

    @property
    def is_settled(self) -> bool:
        """Whether the start is forgotten."""
        return self.age * self.pole > SETTLED

    def update(self, dt: float, u: Array) -> tuple[Array, Array]:
        """Return filtered values and derivatives, two (m,), dt [s] after the last input."""
        w = self.pole
        slope = (u - self._input) / dt
        if self.age == 0.0:
            self._x = self._input - 2.0 * slope / w
            self._v = slope
        self.age += dt
        off = self._x - self._input + 2.0 * slope / w
        fade = np.exp(-w * dt)
        rate = self._v - slope + w * off
        self._x = u - 2.0 * slope / w + (off + rate * dt) * fade
        self._v = slope + (rate - w * (off + rate * dt)) * fade
        self._input = u
        return self._x, self._v


def filter_pole(bandwidth: float, rate: float) -> float:
    """Return the pole [rad/s] for an observer of `bandwidth` [Hz] at a sampling rate [Hz]."""
    # 0.25: fastest pole per sampling rate; a faster one passes quantisation on.
    # 4.0: pole of the filter per pole of the observer, so that it is late by half of the observer's
    # lag.
    return float(min(4.0 * 2.0 * np.pi * bandwidth, 0.25 * 2.0 * np.pi * rate))


def choose_pole(steps: Array, bandwidth: float) -> float:
    """Return the pole [rad/s] for an observer of `bandwidth` [Hz] and time steps [s] of a log.

    Steps that are not positive do not count.
    """
    forward = steps[steps > 0.0]
    return filter_pole(bandwidth, 1.0 / float(np.median(forward)) if forward.size else 1e3)


def filter_log(dt: Array, q: Array, tau: Array, pole: float) -> tuple[Array, Array, Array, Mask]:
    """Return filtered positions, their derivatives and filtered torques of a log, three (N, n).

    `dt` (N,) are the steps before each sample; one that is not positive starts again. The mask (N,)
    says where the filter has forgotten its start.
    """
    n = q.shape[1]
    both = np.hstack([q, tau])
    x = both.copy()
    v = np.zeros(both.shape)
    settled = np.zeros(len(both), dtype=bool)
    running = CausalFilter(pole)
    for k, (step, u) in enumerate(zip(dt, both, strict=True)):
        if not step > 0.0 or k == 0:
            running.start(u)
        else:
            x[k], v[k] = running.update(step, u)
        settled[k] = running.is_settled
    return x[:, :n].copy(), v[:, :n].copy(), x[:, n:].copy(), settled


GAIN = float(np.sqrt(70.0))
"""Standard deviation of fourth differences of white noise of 1: root of 1 + 16 + 36 + 16 + 1."""


def largest_velocity_error(
    logs: Sequence[tuple[Array, Array, Array | None]], pole: float | None = None
) -> Array:
    """Return the largest error (n,) of velocities [rad/s or m/s]: three standard deviations.

    Noise is estimated from fourth differences (their median size, without zeros), in which
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
        kept = find_finite_rows(t, q)
        if pole is not None:
            x = q[kept]
            found.append(
                _estimate_noise(x, x[ORDER:] - x[:-ORDER])
                * _evaluate_derivative_gain(pole, float(np.median(np.diff(t))))
            )
        elif qd is not None:
            x = qd[kept & find_finite_rows(qd)]
            found.append(_estimate_noise(x, x[ORDER:] + x[:-ORDER]))
    return np.asarray(LARGEST * np.max(found, axis=0))


def _estimate_noise(x: Array, rate: Array) -> Array:
    """Return the standard deviation (n,) of white noise in columns (N, n) where `rate` is least."""
    sizes = np.abs(np.diff(x, ORDER, axis=0))
    found = []
    for size, speed in zip(sizes.T, np.abs(rate).T, strict=True):
        near = size[speed <= np.quantile(speed, SLOWEST)] if size.size else size
        found.append(np.median(near[near > 0.0]) if near.any() else 0.0)
    # Median of the absolute value of a standard normal variable.
    return np.array(found) / (0.6745 * GAIN)


def _evaluate_derivative_gain(pole: float, spacing: float) -> float:
    """Return the standard deviation of the filter's derivative for unit white noise."""
    running = CausalFilter(pole)
    total = 0.0
    running.start(np.zeros(1))
    running.age = SETTLED / pole
    for k in range(1 + int(np.ceil(2.0 * SETTLED / (pole * spacing)))):
        total += float(running.update(spacing, np.ones(1) * (k == 0))[1][0]) ** 2
    return float(np.sqrt(total))
