"""Choice between logged velocities and differentiated positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.signal.differentiation import central_differences
from asbuilt.experiment.signal.lowpass import butterworth, settling_samples
from asbuilt.experiment.signal.resampling import UniformSegment

LARGEST_GAIN_ERROR = 0.02
"""Largest deviation of its scale from the scale of the derivative."""


@dataclass(frozen=True, slots=True)
class VelocityVerdict:
    """Hold lag [s] and gain of the worst joint, and the median noise ratio."""

    lag: float
    gain: float
    noise: float
    rate: float

    @property
    def helps(self) -> bool:
        """Whether lag and gain error are small and the noise is at most half."""
        # Largest lag of a usable velocity behind the position's derivative, in sample periods.
        # 0.5: largest share that its noise may have of the noise of the differentiated position.
        return (
            abs(self.lag) * self.rate <= 0.25
            and abs(self.gain - 1.0) <= LARGEST_GAIN_ERROR
            and self.noise <= 0.5
        )

    @property
    def clock_bound(self) -> float:
        """Largest error of the clock, as a share, that the logged velocities admit.

        A clock that is off by a share turns the derivative of every position by as much against a
        velocity that the drive measures.
        """
        return abs(self.gain - 1.0) + LARGEST_GAIN_ERROR

    def __str__(self) -> str:
        verdict = "used" if self.helps else "not used"
        return (
            f"logged velocities {verdict}: they lag the positions' derivative by"
            f" {1e3 * self.lag:.2g} ms, gain {self.gain:.3f}, noise {self.noise:.2g} of the"
            " derivative's"
        )


def validate_velocities(
    segments: Sequence[UniformSegment], rate: float, cutoff: float, order: int = 4
) -> VelocityVerdict | None:
    """Compare logged velocities with positions that are differentiated and low-passed alike.

    None if velocities are not logged in every segment, or no segment outlasts the low-pass.
    """
    pairs = []
    for segment in segments:
        if segment.qd is None:
            return None
        if segment.t.size > 2 * settling_samples(cutoff, rate, order=order):
            derived = central_differences(segment.q, rate)
            smooth, logged = (
                butterworth(x, cutoff=cutoff, rate=rate, order=order) for x in (derived, segment.qd)
            )
            pairs.append((smooth, logged, derived, segment.qd))
    return compare_velocities(pairs, rate) if pairs else None


def compare_velocities(
    pairs: Sequence[tuple[Array, Array, Array, Array]], rate: float
) -> VelocityVerdict:
    """Compare logged velocities with the derivative of the positions.

    Each of `pairs` holds, for one segment, the low-passed derivative v, the logged velocity w
    low-passed alike, and both before the low-pass. To first order w(t) = gain v(t - lag) = gain v -
    gain lag dv/dt, whose two coefficients follow by least squares, joint by joint. Noise is what
    the low-pass removes.
    """
    n = pairs[0][0].shape[1]
    lags, gains, noises = np.zeros(n), np.ones(n), np.ones(n)
    speed = np.sqrt(sum(np.sum(v**2, axis=0) for v, *_ in pairs))
    for k in range(n):
        v = np.concatenate([pair[0][:, k] for pair in pairs])
        w = np.concatenate([pair[1][:, k] for pair in pairs])
        a = np.concatenate([np.gradient(pair[0][:, k]) * rate for pair in pairs])
        (gain, slope), *_ = np.linalg.lstsq(np.column_stack([v, a]), w, rcond=None)
        lags[k], gains[k] = -slope / gain if gain else np.inf, gain
        removed = [
            np.sqrt(sum(float(np.sum((pair[2 + i][:, k] - pair[i][:, k]) ** 2)) for pair in pairs))
            for i in range(2)
        ]
        noises[k] = removed[1] / removed[0] if removed[0] > 0 else np.inf
    moving = speed > 0.01 * speed.max()
    worst = int(np.abs(np.where(moving, lags, 0.0)).argmax())
    scale = int(np.abs(np.where(moving, gains - 1.0, 0.0)).argmax())
    return VelocityVerdict(
        float(lags[worst]),
        float(gains[scale]),
        float(np.median(noises[moving])) if moving.any() else np.inf,
        rate,
    )
