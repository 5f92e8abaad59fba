"""Zero-phase low-pass filters: Butterworth forwards and backwards, and Chebyshev decimation."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.compilation import kernel
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.parallel_filter import filter_rows

SPREAD = 0.5
"""Half the width of a Gaussian kernel, in periods of its cutoff: 3.8 standard deviations."""
HALF_WIDTH = 16
"""Samples on either side that a shift by a fraction of a sample takes."""
AT_ONCE = 4
"""Columns that are filtered together."""


def single_pass_cutoff(cutoff: float, rate: float, order: int) -> float:
    """Return the -3 dB cutoff [Hz] of one pass whose double pass has -3 dB at `cutoff` [Hz].

    The double pass has the amplitude 1 / (1 + r^(2 order)) with r the ratio of bilinearly warped
    frequencies tan(pi f / rate), which is 1 / sqrt(2) where r = (sqrt(2) - 1)^(1 / (2 order)), that
    is 0.80 for order 2 and 0.90 for order 4 (Winter, Biomechanics and Motor Control of Human
    Movement, 2009).

    Examples
    --------
    >>> round(single_pass_cutoff(8.0, 1000.0, 2), 3)
    9.971
    """
    # (sqrt(2) - 1)^(1 / (2 order)) is where the squared amplitude is 1 / sqrt(2), in warped
    # frequency.
    warped = np.tan(np.pi * cutoff / rate) / (np.sqrt(2.0) - 1.0) ** (0.5 / order)
    return float(np.arctan(warped) * rate / np.pi)


def butterworth(
    x: ArrayLike, *, cutoff: float, rate: float, order: int = 4, corrected: bool = True
) -> Array:
    """Low-pass the columns of x (N,) or (N, m) with a Butterworth filter forwards and backwards.

    The phase is zero, the amplitude 1 / (1 + r^(2 order)). `cutoff` [Hz] is where the amplitude of
    the whole, both passes together, is 1 / sqrt(2); with `corrected=False` it is the cutoff of each
    pass, and the whole has 1/2 there. The ends are extended by odd reflection, so straight lines
    pass; other effects of the ends last `settling_samples`.

    Raises
    ------
    UsageError
        If the cutoff does not lie between 0 and the Nyquist frequency.

    Examples
    --------
    >>> t = np.arange(0.0, 10.0, 0.01)
    >>> x = butterworth(np.sin(2 * np.pi * 5.0 * t), cutoff=5.0, rate=100.0)
    >>> round(float(np.abs(x[300:700]).max()), 4)
    0.7071
    """
    values = np.asarray(x, dtype=np.float64)
    sections, steady = _design_filter(cutoff, rate, order, corrected)
    # Odd reflection as long as the response, or as the log allows.
    padding = min(
        settling_samples(cutoff, rate, order=order, corrected=corrected, tolerance=1e-6),
        values.shape[0] - 1,
    )
    return _filter_both_ways(values, sections, steady, padding)


def gaussian(x: ArrayLike, *, cutoff: float, rate: float, shorter: int = 0) -> Array:
    """Low-pass the columns of x (N,) or (N, m) with a Gaussian kernel of finite width.

    The amplitude is `exp(-2 (pi sigma f)^2)`, 1 / sqrt(2) at `cutoff` [Hz]. The kernel ends
    `shorter` samples before half a period of the cutoff (3.8 sigma), so that what happens once is
    seen in a known time about it and nowhere else. The ends are extended by odd reflection.

    >>> x = np.zeros(101)
    >>> x[50] = 1.0
    >>> np.flatnonzero(gaussian(x, cutoff=5.0, rate=100.0))[[0, -1]].tolist()
    [40, 60]
    """
    values = np.asarray(x, dtype=np.float64)
    half = kernel_samples(cutoff, rate, shorter)
    # exp(-2 (pi sigma f)^2) = 1 / sqrt(2), sigma in samples.
    sigma = np.sqrt(np.log(2.0)) * rate / (2.0 * np.pi * cutoff)
    taps = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    columns = np.ascontiguousarray(values.reshape(len(values), -1).T)
    rows = np.pad(columns, ((0, 0), (half, half)), "reflect", reflect_type="odd")
    kept = filter_rows(rows, taps / taps.sum()).T
    return kept[:, 0] if values.ndim == 1 else kept


def kernel_samples(cutoff: float, rate: float, shorter: int = 0) -> int:
    """Return the samples of the kernel of `gaussian` to either side of its middle, at least one."""
    # 1e-9: half a period that is a whole number of samples stays one.
    return max(1, int(SPREAD * rate / cutoff + 1e-9) - shorter)


@lru_cache(maxsize=256)
def settling_samples(
    cutoff: float, rate: float, *, order: int = 4, corrected: bool = True, tolerance: float = 0.01
) -> int:
    """Return after how many samples the double pass has settled to `tolerance` of its peak.

    The impulse response dies as the slowest pole p does, |p|^k; the count is read from the response
    itself, which is the autocorrelation of one pass.
    """
    sections, steady = _design_filter(cutoff, rate, order, corrected)
    slowest = max(abs(root) for section in sections for root in np.roots(section[3:]))
    # From the slowest pole, with some margin: the response itself is then looked at.
    length = int(np.ceil(np.log(1e-3 * tolerance) / np.log(slowest))) + 1
    rows = np.zeros((AT_ONCE, 2 * length))
    rows[0, 0] = 1.0
    _filter_in_place(rows, sections, 0.0 * steady)
    # Forwards and backwards an impulse becomes the autocorrelation of one pass.
    double = np.abs(rows[0])
    return int(np.flatnonzero(double > tolerance * double.max())[-1]) + 1


def decimate_chebyshev(x: Array, factor: int) -> Array:
    """Keep every `factor`-th row of x (N,) or (N, m) after a zero-phase Chebyshev type I filter.

    The filter of order 8 has 0.05 dB of ripple in each pass and its edge at 0.8 of the new Nyquist
    frequency (IEEE, Programs for Digital Signal Processing, 1979, chapter 8), as
    `scipy.signal.decimate` has.
    """
    from scipy.signal import decimate  # noqa: PLC0415 - light start

    return np.ascontiguousarray(decimate(x, factor, n=8, ftype="iir", axis=0, zero_phase=True))


def _filter_both_ways(x: Array, sections: Array, steady: Array, padding: int) -> Array:
    """Filter the columns of x (N,) or (N, m) forwards and backwards, as `scipy.signal.sosfiltfilt`.

    The ends are extended by odd reflection over `padding` < N samples, and the filter starts in its
    steady state there. Columns of the result are contiguous.
    """
    length = x.shape[0]
    columns = x.reshape(length, -1).T
    m = len(columns)
    # Rows in fours, padded with zeros.
    rows = np.zeros((-(-m // AT_ONCE) * AT_ONCE, length + 2 * padding))
    rows[:m, padding : padding + length] = columns
    if padding:
        # Straight lines continue as straight lines.
        rows[:m, :padding] = 2.0 * columns[:, :1] - columns[:, padding:0:-1]
        rows[:m, -padding:] = 2.0 * columns[:, -1:] - columns[:, -2 : -padding - 2 : -1]
    _filter_in_place(rows, sections, steady)
    # Views: the padding is dropped without a copy.
    kept = rows[:m, padding : padding + length].T
    return kept[:, 0] if x.ndim == 1 else kept


def _solve_steady_state(sections: Array) -> Array:
    """Return the states (m, 2) of sections (m, 6) that the input 1 has held for long.

    The states (p, q) of a section with the input 1 solve `p = q + b1 - a1 (p + b0)`,
    `q = b2 - a2 (p + b0)`; its input is the gain of the sections before.
    """
    b = sections[:, :3]
    a = sections[:, 3:]
    system = np.tile(np.eye(2), (len(sections), 1, 1))
    system[:, 0, 1] = -1.0
    system[:, :, 0] += a[:, 1:]
    # Each section sees the gain of those before it as its constant input.
    states = np.linalg.solve(system, (b[:, 1:] - a[:, 1:] * b[:, :1])[..., None])[..., 0]
    gain = np.cumprod(np.append(1.0, b.sum(axis=1) / a.sum(axis=1)))[:-1]
    return np.asarray(gain[:, None] * states)


@kernel("F2 f2 f2", usual=True)
def _filter_in_place(rows: Array, sections: Array, steady: Array) -> None:
    """Filter rows (4 k, L) forwards and backwards by second-order sections.

    Each section is a transposed direct form II (Oppenheim & Schafer, Discrete-Time Signal
    Processing, 2010, section 6.3). Four rows at once hide the latency of its recursion.
    """
    last = rows.shape[1] - 1
    for g in range(0, rows.shape[0], 4):
        r0 = rows[g]
        r1 = rows[g + 1]
        r2 = rows[g + 2]
        r3 = rows[g + 3]
        for way in range(2):
            # The state that the first sample would have held for ever: no step at the ends.
            at = last if way else 0
            u0 = r0[at]
            u1 = r1[at]
            u2 = r2[at]
            u3 = r3[at]
            for s in range(sections.shape[0]):
                b0 = sections[s, 0]
                b1 = sections[s, 1]
                b2 = sections[s, 2]
                a1 = sections[s, 4]
                a2 = sections[s, 5]
                p0 = steady[s, 0] * u0
                p1 = steady[s, 0] * u1
                p2 = steady[s, 0] * u2
                p3 = steady[s, 0] * u3
                q0 = steady[s, 1] * u0
                q1 = steady[s, 1] * u1
                q2 = steady[s, 1] * u2
                q3 = steady[s, 1] * u3
                for k in range(last + 1):
                    # The way back runs over the same rows in reverse.
                    j = last - k if way else k
                    x0 = r0[j]
                    x1 = r1[j]
                    x2 = r2[j]
                    x3 = r3[j]
                    y0 = b0 * x0 + p0
                    y1 = b0 * x1 + p1
                    y2 = b0 * x2 + p2
                    y3 = b0 * x3 + p3
                    p0 = b1 * x0 - a1 * y0 + q0
                    p1 = b1 * x1 - a1 * y1 + q1
                    p2 = b1 * x2 - a1 * y2 + q2
                    p3 = b1 * x3 - a1 * y3 + q3
                    q0 = b2 * x0 - a2 * y0
                    q1 = b2 * x1 - a2 * y1
                    q2 = b2 * x2 - a2 * y2
                    q3 = b2 * x3 - a2 * y3
                    r0[j], r1[j], r2[j], r3[j] = y0, y1, y2, y3


@lru_cache(maxsize=256)
def _design_filter(cutoff: float, rate: float, order: int, corrected: bool) -> tuple[Array, Array]:
    """Return the sections (m, 6) of a low-pass, and their steady state (m, 2) for the input 1."""
    if not 0.0 < cutoff < 0.5 * rate:
        raise UsageError(
            f"a low-pass at {cutoff:g} Hz is impossible at {rate:g} Hz: the cutoff must lie between"
            f" 0 and {0.5 * rate:g} Hz"
        )
    sections = butterworth_sections(
        order, single_pass_cutoff(cutoff, rate, order) if corrected else cutoff, rate
    )
    return sections, _solve_steady_state(sections)


def butterworth_sections(order: int, cutoff: float, rate: float) -> Array:
    """Return second-order sections `b0 b1 b2 1 a1 a2` of a low-pass, the most damped pole first.

    The poles `s_k = -w exp(i pi k / (2 order))`, w = 4 tan(pi cutoff / rate), go
    through the bilinear map `z = (4 + s) / (4 - s)`, and all zeros lie at -1 (Oppenheim & Schafer,
    Discrete-Time Signal Processing, 2010, section 7.3). The first section has the gain of all. As
    `scipy.signal.butter`, whose package takes long to import.
    """
    w = 4.0 * np.tan(np.pi * (cutoff / (0.5 * rate)) / 2.0)
    s = w * -np.exp(0.5j * np.pi * np.arange(1.0 - order, order, 2.0) / order)
    # Conjugate pairs share a section, so that its coefficients are real.
    z = ((4.0 + s) / (4.0 - s))[order // 2 :]  # a real pole, then one of each conjugate pair
    sections = np.tile([1.0, 2.0, 1.0, 1.0, 0.0, 0.0], (len(z), 1))
    sections[:, 4], sections[:, 5] = -2.0 * z.real, z.real**2 + z.imag**2
    # An odd order has a real pole, with a section of first order.
    if order % 2:
        sections[0] = 1.0, 1.0, 0.0, 1.0, -z[0].real, 0.0
    sections[0, :3] *= w**order * (1.0 / np.prod(4.0 - s)).real
    return sections


def shift_in_time(x: Array, delay: Array, rate: float) -> Array:
    """Return x (L, n), whose value at time t is the one at `t + delay`, (n,) [s].

    Fractions of a sample by a Kaiser-windowed sinc (Laakso et al., Splitting the unit delay, IEEE
    Signal Processing Magazine 13, 1996), flat to 0.4 of the rate. At the ends, where nothing was
    logged, x is continued by its odd reflection.
    """
    steps = (delay * rate).tolist()
    return np.stack([_shift(column, late) for column, late in zip(x.T, steps, strict=True)], axis=1)


def _shift(x: Array, steps: float) -> Array:
    """Return x (L,) at every index plus `steps`, a real number."""
    whole = round(steps)
    part = steps - whole
    padded = np.pad(x, HALF_WIDTH + abs(whole), mode="reflect", reflect_type="odd")
    # The whole part of the shift is an index; only the rest is filtered.
    begin = whole + abs(whole)
    if abs(part) < 1e-9:
        return padded[begin + HALF_WIDTH : begin + HALF_WIDTH + x.size]
    offsets = np.arange(-HALF_WIDTH, HALF_WIDTH + 1)
    # Shape of its window: side lobes of -80 dB.
    window = np.i0(8.0 * np.sqrt(np.maximum(1.0 - ((offsets - part) / (HALF_WIDTH + 1)) ** 2, 0)))
    # Of unit sum, so that a constant stays.
    taps = np.sinc(offsets - part) * window
    return np.convolve(
        padded[begin : begin + x.size + 2 * HALF_WIDTH], (taps / taps.sum())[::-1], "valid"
    )
