"""Derivatives of sampled positions, their comparison with logged velocities, and joints at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Mask, find_true_ranges
from asbuilt.compilation import kernel
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.lowpass import butterworth, settling_samples
from asbuilt.experiment.signal.resampling import UniformSegment
from asbuilt.findings import Cure


def central_differences(x: ArrayLike, rate: float) -> Array:
    """Differentiate the columns of x (N,) or (N, m) by central differences.

    x'[k] = (x[k+1] - x[k-1]) rate / 2, exact on parabolas; second-order one-sided at the ends. A
    sine of frequency f is attenuated by sin(w) / w, w = 2 pi f / rate, without phase.

    Examples
    --------
    >>> central_differences([0.0, 1.0, 4.0, 9.0], rate=1.0).tolist()
    [0.0, 2.0, 4.0, 6.0]
    """
    values = np.asarray(x, dtype=np.float64)
    if values.shape[0] < 3:
        raise UsageError(f"central differences need at least 3 samples, got {values.shape[0]}")
    slopes = np.empty_like(values)
    np.subtract(values[2:], values[:-2], out=slopes[1:-1])
    slopes[1:-1] *= 0.5 * rate
    # Parabolas through the three samples at each end.
    slopes[0] = rate * (-1.5 * values[0] + 2.0 * values[1] - 0.5 * values[2])
    slopes[-1] = rate * (0.5 * values[-3] - 2.0 * values[-2] + 1.5 * values[-1])
    return slopes


DEGREE = 4
"""Degree of the moving polynomial, even."""


def savitzky_golay(x: ArrayLike, rate: float, *, cutoff: float) -> tuple[Array, Array, Array]:
    """Return value, first and second derivative of the columns of x by a moving polynomial.

    `savitzky_golay_window` gives the window. Exact on polynomials up to `DEGREE`, also at the ends
    (Savitzky and Golay, Analytical Chemistry, 1964).
    """
    values = np.asarray(x, dtype=np.float64)
    _check_cutoff(cutoff, rate)
    window = savitzky_golay_window(cutoff, rate)
    if window > values.shape[0]:
        raise UsageError(
            f"a Savitzky-Golay cutoff of {cutoff:g} Hz needs {window} samples at {rate:g} Hz, but"
            f" the segment has {values.shape[0]}",
            cure=Cure("raise the cutoff"),
            value=values.shape[0],
            lower=window,
        )
    from scipy.signal import savgol_filter  # noqa: PLC0415 - light start

    q, qd, qdd = (
        np.ascontiguousarray(
            # At the ends the polynomial of the last window, instead of a shorter one.
            savgol_filter(values, window, DEGREE, deriv=d, delta=1.0 / rate, axis=0, mode="interp")
        )
        for d in range(3)
    )
    return q, qd, qdd


def _check_cutoff(cutoff: float, rate: float) -> None:
    if not 0.0 < cutoff < 0.5 * rate:
        raise UsageError(
            f"a cutoff of {cutoff:g} Hz is impossible at {rate:g} Hz: it must lie between 0 and"
            f" {0.5 * rate:g} Hz"
        )


def savitzky_golay_window(cutoff: float, rate: float) -> int:
    """Return the window length 2 m + 1 whose -3 dB point is nearest `cutoff` [Hz].

    It is longer than the polynomial has coefficients. Schafer's rule, cutoff / (rate / 2) =
    (degree + 1) / (3.2 m - 4.6) (What is a Savitzky-Golay filter?, IEEE Signal Processing Magazine,
    2011).
    """
    # Solved for m, half the window without its middle.
    half = ((DEGREE + 1) / (2.0 * cutoff / rate) + 4.6) / 3.2
    return max(2 * round(half) + 1, DEGREE + 3)


def smoothing_spline(x: ArrayLike, rate: float, *, cutoff: float) -> tuple[Array, Array, Array]:
    """Return value, first and second derivative of the columns of x by a smoothing spline.

    With time k counted in samples the spline minimises sum (x - s)^2 + lambda int s''^2 dk
    (Reinsch, Numerische Mathematik, 1967). Away from the ends it is a zero-phase filter of
    amplitude 1 / (1 + lambda w^4), w = 2 pi f / rate (Craven and Wahba, Numerische Mathematik,
    1979), so lambda follows from -3 dB at `cutoff` [Hz].
    """
    values = np.asarray(x, dtype=np.float64)
    _check_cutoff(cutoff, rate)
    if values.shape[0] < 5:
        raise UsageError(f"a smoothing spline needs at least 5 samples, got {values.shape[0]}")
    # 1 / (1 + lambda w^4) is 1 / sqrt(2) at the cutoff.
    lam = (np.sqrt(2.0) - 1.0) / (2.0 * np.pi * cutoff / rate) ** 4
    k = np.arange(values.shape[0], dtype=np.float64)
    from scipy.interpolate import make_smoothing_spline  # noqa: PLC0415 - light start

    spline = make_smoothing_spline(k, values, lam=lam, axis=0)
    q, qd, qdd = (
        np.ascontiguousarray(spline.derivative(d)(k) if d else spline(k)) * rate**d
        # Time counts in samples: each derivative brings a factor of the rate.
        for d in range(3)
    )
    return q, qd, qdd


LARGEST_GAIN_ERROR = 0.02
"""Largest deviation of its scale from the scale of the derivative."""


@dataclass(frozen=True, slots=True)
class VelocityQuality:
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
        use = "used" if self.helps else "not used"
        return (
            f"logged velocities {use}: they lag the positions' derivative by"
            f" {1e3 * self.lag:.2g} ms, gain {self.gain:.3f}, noise {self.noise:.2g} of the"
            " derivative's"
        )


def validate_velocities(
    segments: Sequence[UniformSegment], rate: float, cutoff: float, order: int = 4
) -> VelocityQuality | None:
    """Compare logged velocities with positions that are differentiated and low-passed alike.

    None if velocities are not logged in every segment, or no segment outlasts the low-pass.
    """
    pairs = []
    for segment in segments:
        if segment.qd is None:
            return None
        # Shorter ones are transient of the low-pass from end to end.
        if segment.t.size > 2 * settling_samples(cutoff, rate, order=order):
            derived = central_differences(segment.q, rate)
            smooth, logged = (
                butterworth(x, cutoff=cutoff, rate=rate, order=order) for x in (derived, segment.qd)
            )
            pairs.append((smooth, logged, derived, segment.qd))
    return compare_velocities(pairs, rate) if pairs else None


def compare_velocities(
    pairs: Sequence[tuple[Array, Array, Array, Array]], rate: float
) -> VelocityQuality:
    """Compare logged velocities with the derivative of the positions.

    Each of `pairs` holds, for one segment, the low-passed derivative v, the logged velocity w
    low-passed alike, and both before the low-pass. To first order w(t) = gain v(t - lag) = gain v -
    gain lag dv/dt, whose two coefficients follow by least squares, joint by joint. Noise is what
    the low-pass removes.
    """
    v, w, derived, logged = (np.concatenate(x) for x in zip(*pairs, strict=True))
    a = np.concatenate([np.gradient(smooth, axis=0) * rate for smooth, *_ in pairs])
    n = v.shape[1]
    lags = np.zeros(n)
    gains = np.ones(n)
    for k in range(n):
        # w = gain v - gain lag dv/dt
        columns = np.column_stack([v[:, k], a[:, k]])
        gains[k], slope = np.linalg.lstsq(columns, w[:, k], rcond=None)[0]
        lags[k] = -slope / gains[k] if gains[k] else np.inf
    # What the low-pass takes from each, before less after.
    removed, removed_logged = (
        np.linalg.norm(before - after, axis=0) for before, after in ((derived, v), (logged, w))
    )
    noises = np.divide(removed_logged, removed, out=np.full(n, np.inf), where=removed > 0.0)
    speed = np.linalg.norm(v, axis=0)
    # A joint at rest has a derivative of noise alone.
    moving = speed > 0.01 * speed.max()
    worst = int(np.abs(np.where(moving, lags, 0.0)).argmax())
    scale = int(np.abs(np.where(moving, gains - 1.0, 0.0)).argmax())
    return VelocityQuality(
        float(lags[worst]),
        float(gains[scale]),
        float(np.median(noises[moving])) if moving.any() else np.inf,
        rate,
    )


SLOWEST = 0.0015
"""Share of the fastest joint's top speed below which any joint may be at rest, but for `MOVING`."""
MOVING = 0.006
"""Share of its own top speed beyond which a joint moves, however slow compared with others: a
finger in m/s among joints in rad/s."""
PAUSE = 0.5
"""Least duration [s] of a rest; a reversal is shorter."""


def estimate_standstill_speeds(
    motions: Sequence[tuple[Array, Array]], cutoff: float
) -> tuple[float, ...]:
    """Return the speed of each joint below which it may be at rest.

    `motions` are positions and velocities (L, n) of segments, behind a low-pass of `cutoff` [Hz].
    """
    # 99 %: single samples of noise are no speed.
    top = np.max([np.quantile(np.abs(qd), 0.99, axis=0) for _, qd in motions], axis=0)
    swept = np.max([np.ptp(q, axis=0) for q, _ in motions], axis=0)
    # 10.0: position range, in top speeds over the cutoff [rad/s], from which a joint moves at all;
    # noise below the cutoff has about 5, a sine of a fifth of its frequency 10.
    moves = swept * 2.0 * np.pi * cutoff > 10.0 * top
    # Of a joint that moves slowly, its own speed decides; a still one has only noise.
    least = np.where(moves, np.minimum(SLOWEST * top.max(), MOVING * top), SLOWEST * top.max())
    # Share of a joint's top speed below which it may be at rest.
    return tuple(np.maximum(0.003 * top, least).tolist())


def find_rests(qd: Array, speeds: Sequence[float], rate: float) -> Mask:
    """Return where each joint is at rest, (L, n): slower than its speed for `PAUSE` or longer."""
    slow = np.ascontiguousarray(np.abs(qd.T) < np.asarray(speeds)[:, None])
    for slow_joint in slow:
        _keep_lasting(slow_joint, PAUSE * rate)
    return slow.T


def find_moving_ranges(still: Mask, rate: float, shoulder: int) -> list[tuple[int, int]]:
    """Return the index ranges without rests of all joints, but `shoulder` samples at their ends.

    During a rest friction takes any value up to the Coulomb torque, which a model whose friction
    follows the velocity does not describe.
    """
    rest = np.array(still.all(axis=1))
    _keep_lasting(rest, PAUSE * rate)
    keep = ~rest
    # What the parallel filter reaches of a rest stays, so that its outputs up to there exist.
    for a, b in find_true_ranges(rest):
        keep[a : a + shoulder if a > 0 else a] = True
        keep[max(b - shoulder, a) if b < rest.size else b : b] = True
    return find_true_ranges(keep)


@kernel("B1 f", usual=True)
def _keep_lasting(mask: Mask, samples: float) -> None:
    """Set runs of true values that are shorter than `samples` to false."""
    length = 0
    # One past the end closes a run that lasts to it.
    for k in range(mask.size + 1):
        if k < mask.size and mask[k]:
            length += 1
        else:
            if length < samples:
                for j in range(k - length, k):
                    mask[j] = False
            length = 0
