"""A recording on an even clock, smoothed just enough to differentiate it twice: the basis of the checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from asbuilt.experiment.recording import Recording

Array = NDArray[np.float64]

GAP_STEPS = 5.0
"""A time step this many times the median is a gap."""
_WINDOW = 0.15
_STRETCH_SAMPLES = 4000
_MOST_STRETCHES = 12


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """Evenly sampled stretches of a recording, one after another: `q, qd, qdd, tau` (N, n); `logged_qd` where velocities were logged.

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


def smoothed_motion(recording: Recording) -> SmoothedMotion | None:
    """Smooth positions and torques alike by local cubics over 0.15 s (Savitzky and Golay, 1964), between gaps and without bad samples.

    Long recordings are sampled by a dozen stretches. None where no stretch is long enough.
    """
    columns = [recording.q, recording.tau] + ([recording.qd] if recording.qd is not None else [])
    good = np.isfinite(recording.t) & np.all([np.all(np.isfinite(values), axis=1) for values in columns], axis=0)
    t, first = np.unique(recording.t[good], return_index=True)
    if t.size < 20:
        return None
    step = float(np.median(np.diff(t)))
    window = max(5, int(_WINDOW / step) | 1)
    rows = np.flatnonzero(good)[first]
    breaks = np.flatnonzero(np.diff(t) > GAP_STEPS * step) + 1
    bounds = [(a, b) for a, b in zip([0, *breaks], [*breaks, t.size], strict=True) if b - a > 2 * window]
    pieces = [(a, min(a + _STRETCH_SAMPLES, b)) for start, b in bounds for a in range(start, b, _STRETCH_SAMPLES)]
    pieces = [(a, b) for a, b in pieces if b - a > 2 * window]
    if not pieces:
        return None
    if len(pieces) > _MOST_STRETCHES:
        pieces = [pieces[k] for k in np.linspace(0, len(pieces) - 1, _MOST_STRETCHES).astype(int)]
    smooth: list[list[Array]] = []
    numbers = []
    for number, (a, b) in enumerate(pieces):
        even = np.arange(t[a], t[b - 1], step)
        q, tau, *rest = [_resampled(even, t[a:b], values[rows[a:b]]) for values in columns]
        inner = slice(window // 2, -(window // 2))
        derivatives = [savgol_filter(q, window, 3, deriv=k, delta=step, axis=0)[inner] for k in range(3)]
        smooth.append([*derivatives, *(savgol_filter(values, window, 3, axis=0)[inner] for values in (tau, *rest))])
        numbers.append(np.full(smooth[-1][0].shape[0], number, dtype=np.int64))
    joined = [np.concatenate(parts) for parts in zip(*smooth, strict=True)]
    return SmoothedMotion(
        joined[0], joined[1], joined[2], joined[3], joined[4] if len(joined) > 4 else None, np.concatenate(numbers), 1.0 / step
    )


def _resampled(even: Array, t: Array, values: Array) -> Array:
    return np.column_stack([np.interp(even, t, column) for column in values.T])
