"""A recording on an even clock, smoothed just enough to differentiate it twice.

The basis of the checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from asbuilt.arrays import Array
from asbuilt.experiment.recording import Recording

GAP_STEPS = 5.0
"""A time step this many times the median is a gap."""
_WINDOW = 0.15
"""Width of the smoothing [s]."""
_STRETCH_SAMPLES = 4000
_MOST_STRETCHES = 12
"""Samples of a piece, and pieces at most, which is enough to judge by however long the recording."""


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """Evenly sampled stretches of a recording, one after another: `q, qd, qdd, tau` (N, n).

    `logged_qd` where velocities were logged.

    `stretch` (N,) numbers the stretch of each sample; `rate` in Hz.
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    logged_qd: Array | None
    stretch: NDArray[np.int64]
    rate: float

    @property
    def n_samples(self) -> int:
        """Number of samples in all stretches."""
        return int(self.q.shape[0])

    def thinned(self, most: int) -> NDArray[np.int64]:
        """Return the indices of at most about `most` samples, evenly spread."""
        step = max(1, self.n_samples // most)
        return np.arange(0, self.n_samples, step, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class EvenPieces:
    """The pieces of a recording to be smoothed.

    The rows of each, the usual step of the clock [s] and the width of the smoothing in samples.
    """

    rows: tuple[NDArray[np.int64], ...]
    step: float
    window: int

    @classmethod
    def of(cls, t: Array, usable: NDArray[np.bool_]) -> EvenPieces | None:
        """Choose pieces between gaps and without bad samples, of long recordings a dozen.

        None where no stretch is long enough.
        """
        rows = np.flatnonzero(usable)
        t = t[rows]
        if not np.all(np.diff(t) > 0):
            t, first = np.unique(t, return_index=True)
            rows = rows[first]
        if t.size < 20:
            return None
        steps = np.diff(t)
        step = float(np.median(steps))
        window = max(5, int(_WINDOW / step) | 1)
        breaks = np.flatnonzero(steps > GAP_STEPS * step) + 1
        bounds = [
            (a, b)
            for a, b in zip([0, *breaks], [*breaks, t.size], strict=True)
            if b - a > 2 * window
        ]
        pieces = [
            (a, min(a + _STRETCH_SAMPLES, b))
            for start, b in bounds
            for a in range(start, b, _STRETCH_SAMPLES)
        ]
        pieces = [(a, b) for a, b in pieces if b - a > 2 * window]
        if len(pieces) > _MOST_STRETCHES:
            pieces = [
                pieces[k] for k in np.linspace(0, len(pieces) - 1, _MOST_STRETCHES).astype(int)
            ]
        return cls(tuple(rows[a:b] for a, b in pieces), step, window) if pieces else None


def smoothed_motion(pieces: EvenPieces, logged: Sequence[Recording]) -> SmoothedMotion:
    """Smooth positions and torques alike by local cubics over 0.15 s (Savitzky and Golay, 1964).

    `logged` are the samples of every piece.
    """
    smooth: list[list[Array]] = []
    numbers = []
    inner = slice(pieces.window // 2, -(pieces.window // 2))
    for number, part in enumerate(logged):
        columns = [part.q, part.tau] + ([part.qd] if part.qd is not None else [])
        even = np.arange(part.t[0], part.t[-1], pieces.step)
        q, tau, *rest = [_resampled(even, part.t, values) for values in columns]
        derivatives = [
            savgol_filter(q, pieces.window, 3, deriv=k, delta=pieces.step, axis=0)[inner]
            for k in range(3)
        ]
        smooth.append(
            [
                *derivatives,
                *(
                    savgol_filter(values, pieces.window, 3, axis=0)[inner]
                    for values in (tau, *rest)
                ),
            ]
        )
        numbers.append(np.full(smooth[-1][0].shape[0], number, dtype=np.int64))
    joined = [np.concatenate(parts) for parts in zip(*smooth, strict=True)]
    return SmoothedMotion(
        joined[0],
        joined[1],
        joined[2],
        joined[3],
        joined[4] if len(joined) > 4 else None,
        np.concatenate(numbers),
        1.0 / pieces.step,
    )


def _resampled(even: Array, t: Array, values: Array) -> Array:
    return np.column_stack([np.interp(even, t, column) for column in values.T])
