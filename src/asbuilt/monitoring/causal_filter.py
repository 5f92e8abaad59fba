"""Positions, velocities and torques through one causal filter."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array, Mask

SETTLED = 10.0
"""Time in `1 / w` after which the filter has forgotten its start."""


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
        self._input, self._x, self._v = u, u.copy(), np.zeros(u.shape)
        self.age = 0.0

    @property
    def is_settled(self) -> bool:
        """Whether the start is forgotten."""
        return self.age * self.pole > SETTLED

    def update(self, dt: float, u: Array) -> tuple[Array, Array]:
        """Return filtered values and derivatives, two (m,), dt [s] after the last input."""
        w, slope = self.pole, (u - self._input) / dt
        if self.age == 0.0:
            self._x, self._v = self._input - 2.0 * slope / w, slope
        self.age += dt
        off, fade = self._x - self._input + 2.0 * slope / w, np.exp(-w * dt)
        rate = self._v - slope + w * off
        self._x = u - 2.0 * slope / w + (off + rate * dt) * fade
        self._v = slope + (rate - w * (off + rate * dt)) * fade
        self._input = u
        return self._x, self._v


def filter_pole(bandwidth: float, rate: float) -> float:
    """Return the pole [rad/s] beside an observer of `bandwidth` [Hz] at a sampling rate [Hz]."""
    # 0.25: fastest pole per sampling rate; a faster one passes quantisation on.
    # 4.0: pole of the filter per pole of the observer, so that it is late by half of the observer's
    # lag.
    return float(min(4.0 * 2.0 * np.pi * bandwidth, 0.25 * 2.0 * np.pi * rate))


def pole_for(steps: Array, bandwidth: float) -> float:
    """Return the pole [rad/s] beside an observer of `bandwidth` [Hz] for time steps [s] of a log.

    Steps that are not positive do not count.
    """
    forward = steps[steps > 0.0]
    return filter_pole(bandwidth, 1.0 / float(np.median(forward)) if forward.size else 1e3)


def filtered_log(dt: Array, q: Array, tau: Array, pole: float) -> tuple[Array, Array, Array, Mask]:
    """Return filtered positions, their derivatives and filtered torques of a log, three (N, n).

    `dt` (N,) are the steps before each sample; one that is not positive starts anew. The mask (N,)
    says where the filter has forgotten its start.
    """
    n = q.shape[1]
    both = np.hstack([q, tau])
    x, v = both.copy(), np.zeros(both.shape)
    settled = np.zeros(len(both), dtype=bool)
    running = CausalFilter(pole)
    for k, (step, u) in enumerate(zip(dt, both, strict=True)):
        if not step > 0.0 or k == 0:
            running.start(u)
        else:
            x[k], v[k] = running.update(step, u)
        settled[k] = running.is_settled
    return x[:, :n].copy(), v[:, :n].copy(), x[:, n:].copy(), settled
