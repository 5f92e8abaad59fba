"""Parallel filter: low-pass and decimation of torque and every regressor column alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import as_strided

from asbuilt.arrays import Array
from asbuilt.compilation import kernel, part
from asbuilt.curves import find_root
from asbuilt.dynamics.kernels.lanes import LANES, load, splat, store
from asbuilt.errors import UsageError
from asbuilt.findings import Cure

STOP_BAND = 60.0
"""Attenuation of the stop band [dB]."""
STOP_BAND_EDGE = 1.75
"""Lower edge of the stop band, in cutoffs."""

EIGHT = 8
"""Rows that are filtered together."""


@dataclass(frozen=True, eq=False)
class ParallelFilter:
    """Hold a zero-phase finite low-pass followed by decimation.

    Y[k] = sum_j taps[j] x[k decimation + j].

    `taps` (2 margin + 1,) are symmetric with sum 1, so output k belongs to input `k decimation +
    margin` and the first and last `margin` inputs have no output of their own: nothing is assumed
    about what lies beyond the ends. Since tau = Y(q, qd, qdd) chi holds at every instant, F tau =
    (F Y) chi holds for any linear F: filtering both alike adds no bias (Gautier, Janot and
    Vandanjon, IEEE Trans. Control Systems Technology, 2013).

    `cutoff` is the -3 dB frequency [Hz] at the input `rate` [Hz].
    """

    taps: Array
    decimation: int
    cutoff: float
    rate: float

    def __post_init__(self) -> None:
        taps = np.array(self.taps, dtype=np.float64)
        if (
            taps.ndim != 1
            or taps.size % 2 == 0
            # Symmetric taps have no phase; an odd number has a middle sample.
            or not np.allclose(taps, taps[::-1], rtol=0, atol=1e-14)
        ):
            raise UsageError(
                f"a zero-phase filter needs an odd number of symmetric taps, got shape {taps.shape}"
            )
        if self.decimation < 1:
            raise UsageError(f"the decimation must be 1 or more, got {self.decimation}")
        taps.setflags(write=False)
        object.__setattr__(self, "taps", taps)

    @property
    def margin(self) -> int:
        """Number of inputs at either end without an output."""
        return (self.taps.size - 1) // 2

    @property
    def output_rate(self) -> float:
        """Sampling rate of the output [Hz]."""
        return self.rate / self.decimation

    def n_outputs(self, n_inputs: int) -> int:
        """Return the number of outputs of `n_inputs` contiguous samples, 0 if they are too few."""
        # The first output needs all taps, each further one `decimation` inputs more.
        return max(0, (n_inputs - self.taps.size) // self.decimation + 1)

    def apply(self, x: Array, axis: int = -1, out: Array | None = None) -> Array:
        """Filter and decimate one contiguous segment along `axis`: L becomes n_outputs(L).

        Fastest if samples are innermost (`axis=-1`, neighbours in memory). `out`, if given, is
        filled (only for two-dimensional x and axis -1).
        """
        values = np.asarray(x, dtype=np.float64)
        if values.ndim == 2 and axis in (-1, 1) and _has_rows_in_memory(values):
            return filter_rows(values, self.taps, self.decimation, out)
        # Rows are copied once, and filtered as rows in memory.
        moved = np.ascontiguousarray(np.moveaxis(values, axis, -1))
        flat = self.apply(moved.reshape(-1, moved.shape[-1]), -1)
        return np.ascontiguousarray(
            np.moveaxis(flat.reshape(*moved.shape[:-1], flat.shape[-1]), -1, axis)
        )

    def times(self, t: Array) -> Array:
        """Return the times of the outputs for the times t (L,) of one contiguous segment."""
        return np.asarray(t)[
            self.margin : self.margin + self.n_outputs(len(t)) * self.decimation : self.decimation
        ]


@lru_cache(maxsize=64)
def design_parallel_filter(cutoff: float, rate: float, decimation: int = 1) -> ParallelFilter:
    """Design a Kaiser-windowed sinc with -3 dB at `cutoff` [Hz], -60 dB from 1.75 cutoffs.

    The method is Kaiser's (1974).

    Raises
    ------
    UsageError
        If the cutoff is beyond what the rate, or the rate after decimation, can carry without
        aliasing.
    """
    # Beyond, the stop band would begin above half the rate.
    highest = 0.5 * rate / STOP_BAND_EDGE
    if not 0.0 < cutoff <= highest:
        raise UsageError(
            f"a parallel filter at {cutoff:g} Hz is impossible at {rate:g} Hz: it must be above 0"
            f" and at most {highest:g} Hz"
        )
    # 1e-12: a decimation that just fits must not fail by rounding.
    if rate / decimation < 2.0 * STOP_BAND_EDGE * cutoff * (1 - 1e-12):
        raise UsageError(
            f"decimation by {decimation} leaves {rate / decimation:g} Hz, too little for a filter"
            f" at {cutoff:g} Hz",
            cure=Cure(
                f"decimate by at most {int(rate / (2.0 * STOP_BAND_EDGE * cutoff))} or lower the"
                f" cutoff to {rate / decimation / (2 * STOP_BAND_EDGE):g} Hz"
            ),
            value=decimation,
            lower=1,
            upper=int(rate / (2.0 * STOP_BAND_EDGE * cutoff)),
        )
    ratio = cutoff / rate
    # Kaiser's formula for beta by the attenuation.
    beta = 0.1102 * (STOP_BAND - 8.7)
    # 1.2: width of the transition band about the -6 dB point, which is near 1.12 cutoffs, in
    # cutoffs.
    # Kaiser's formula for the number of taps by attenuation and transition band.
    half = int(np.ceil(0.5 * (STOP_BAND - 7.95) / (2.285 * 2.0 * np.pi * 1.2 * ratio)))
    k = np.arange(-half, half + 1)
    window = np.kaiser(2 * half + 1, beta)

    def taps(corner: float) -> Array:
        h = np.sinc(2.0 * corner * k) * window
        return np.asarray(h / h.sum(), dtype=np.float64)

    def excess(corner: float) -> float:
        # -3 dB exactly at the cutoff, which windows shift: the corner is solved for.
        return float(taps(corner) @ np.cos(2.0 * np.pi * ratio * k) - np.sqrt(0.5))

    corner = find_root(excess, 0.3 * ratio, min(1.75 * ratio, 0.5))
    return ParallelFilter(taps(corner), decimation, cutoff, rate)


def filter_rows(x: Array, taps: Array, decimation: int = 1, out: Array | None = None) -> Array:
    """Return `y[i, k] = sum_j taps[j] x[i, k decimation + j]` of x (m, L), where all j exist.

    The numbers of a row are neighbours in memory, and finite: one that is not spreads to seven more
    outputs than take it. `out`, if given, is filled.
    """
    rows, length = x.shape
    count = max(0, (length - taps.size) // decimation + 1)
    if out is None:
        out = np.empty((rows, count))
    if rows and 0 < count < LANES:
        # Zeros behind make as many outputs as are summed at once; theirs are dropped.
        behind = np.zeros((rows, (LANES - count) * decimation))
        out[:] = filter_rows(np.concatenate([x, behind], axis=1), taps, decimation)[:, :count]
    elif rows and count:
        # Eight outputs at once: each input's weights in all of them stand side by side.
        weights = np.zeros((taps.size + (LANES - 1) * decimation, LANES))
        for lane in range(LANES):
            weights[lane * decimation : lane * decimation + taps.size, lane] = taps
        _filter_rows(
            *_flatten_memory(x), rows, weights.reshape(-1), decimation, *_flatten_memory(out), count
        )
    return out


def _flatten_memory(x: Array) -> tuple[Array, int]:
    """Return the memory of an array (m, L) as one row, and where the next of its rows begins."""
    if x.flags.c_contiguous:
        return x.reshape(-1), x.shape[1]
    # Views of larger arrays keep their stride.
    stride = x.strides[0] // x.itemsize
    return as_strided(x, ((len(x) - 1) * stride + x.shape[1],), x.strides[1:]), stride


def _has_rows_in_memory(x: Array) -> bool:
    """Return whether the numbers of each row of x (m, L) are neighbours in memory."""
    apart, step = x.strides
    return x.size > 0 and step == x.itemsize and apart >= x.shape[1] * step


@kernel("f1 i i f1 i F1 i i", usual=True)
def _filter_rows(
    memory: Array,
    stride: int,
    rows: int,
    weights: Array,
    decimation: int,
    out: Array,
    out_stride: int,
    count: int,
) -> None:
    """Write filtered rows, which begin every `stride` numbers of `memory`, to rows of `out`.

    `weights` holds the taps of eight neighbouring outputs for each of the inputs that they span,
    0 where an output does not take it: eight outputs of eight rows are summed at once, every one
    over its inputs in order. The last outputs are summed with some before them again.
    """
    span = weights.size // LANES
    for first in range(0, rows, EIGHT):
        below = min(rows - 1 - first, EIGHT - 1)
        # one call, which is inlined and compiled once
        for k in range(0, count, LANES):
            # The last eight overlap those before, so that no tail is needed.
            at = min(k, count - LANES)
            begin = first * stride + at * decimation
            to = first * out_stride + at
            _sum_eight_rows(memory, begin, stride, below, weights, span, out, to, out_stride)


@part
def _sum_eight_rows(
    memory: Array,
    at: int,
    stride: int,
    below: int,
    weights: Array,
    span: int,
    out: Array,
    to: int,
    out_stride: int,
) -> None:
    """Sum eight outputs of a row and of `below` < 8 rows after it; the last is repeated.

    Rows are slices, whose indices need no check for negative ones.
    """
    r0 = memory[at:][:span]
    # Missing rows repeat the last one, whose sums are written again unchanged.
    r1 = memory[at + min(1, below) * stride :][:span]
    r2 = memory[at + min(2, below) * stride :][:span]
    r3 = memory[at + min(3, below) * stride :][:span]
    r4 = memory[at + min(4, below) * stride :][:span]
    r5 = memory[at + min(5, below) * stride :][:span]
    r6 = memory[at + min(6, below) * stride :][:span]
    r7 = memory[at + min(7, below) * stride :][:span]
    y0 = y1 = y2 = y3 = y4 = y5 = y6 = y7 = splat(0.0)
    for j in range(span):
        w = load(weights, j * LANES)
        y0 = y0 + r0[j] * w
        y1 = y1 + r1[j] * w
        y2 = y2 + r2[j] * w
        y3 = y3 + r3[j] * w
        y4 = y4 + r4[j] * w
        y5 = y5 + r5[j] * w
        y6 = y6 + r6[j] * w
        y7 = y7 + r7[j] * w
    store(out, to, y0)
    store(out, to + min(1, below) * out_stride, y1)
    store(out, to + min(2, below) * out_stride, y2)
    store(out, to + min(3, below) * out_stride, y3)
    store(out, to + min(4, below) * out_stride, y4)
    store(out, to + min(5, below) * out_stride, y5)
    store(out, to + min(6, below) * out_stride, y6)
    store(out, to + min(7, below) * out_stride, y7)
