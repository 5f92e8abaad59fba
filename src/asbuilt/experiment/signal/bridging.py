"""Pauses of the clock that are shorter than the filter resolves, bridged by local polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from asbuilt.arrays import Array, Indices


class Pause(NamedTuple):
    """Hold a pause before usable row `row`: times to fill in, samples `near` it, their times."""

    row: int
    times: Array
    near: slice
    near_times: Array


@dataclass(frozen=True, eq=False)
class Bridges:
    """Hold how the shorter pauses of a clock are filled, every channel alike.

    Parameters
    ----------
    usable
        Usable rows of the recording.
    pauses
        The pauses between them that are filled; if there is none, channels stay as they are.
    t, rows
        Times of the channels once they are filled, and their usable rows.

    Notes
    -----
    Every channel is fitted by a polynomial of degree 5 in least squares, over as many samples on
    either side as are missing, and at least 8: an interpolating spline would continue the slope of
    the noise.
    """

    usable: Indices
    pauses: tuple[Pause, ...]
    t: Array
    rows: Indices

    def fill(self, x: Array) -> Array:
        """Return a channel of the recording (N, n) with its pauses filled."""
        if not self.pauses:
            return x
        x = x[self.usable]
        return _insert(
            x,
            self.pauses,
            [_interpolate_locally(p.near_times, x[p.near], p.times) for p in self.pauses],
        )


def plan_bridges(t: Array, usable: Indices, longest: float, pause: float) -> Bridges:
    """Return bridges of the pauses from `pause` to `longest` [s] between usable rows of times t."""
    logged = t[usable]
    steps = np.diff(logged)
    period = float(np.median(steps))
    pauses = []
    for place in np.flatnonzero((steps > pause) & (steps <= longest)).tolist():
        count = round(float(steps[place]) / period) - 1
        times = logged[place] + np.arange(1, count + 1) * (steps[place] / (count + 1))
        near = _select_around(logged, place, count, pause)
        pauses.append(Pause(place + 1, times, near, logged[near]))
    if not pauses:
        return Bridges(usable, (), t, usable)
    filled = _insert(logged, pauses, [each.times for each in pauses])
    return Bridges(usable, tuple(pauses), filled, np.arange(filled.size))


def _insert(x: Array, pauses: Sequence[Pause], filled: Sequence[Array]) -> Array:
    """Return usable rows (L, ...) with what fills each pause between them."""
    rows = np.repeat([each.row for each in pauses], [len(each) for each in filled])
    return np.insert(x, rows, np.concatenate(filled), axis=0)


def _select_around(t: Array, place: int, count: int, pause: float) -> slice:
    """Return the samples on either side of a pause, up to the next pause."""
    # Fewest samples on either side of a pause that the polynomial is fitted to.
    width = max(8, count)
    first, last = max(place + 1 - width, 0), min(place + 1 + width, t.size)
    earlier = np.flatnonzero(np.diff(t[first : place + 1]) > pause)
    later = np.flatnonzero(np.diff(t[place + 1 : last]) > pause)
    begin = first + int(earlier[-1]) + 1 if earlier.size else first
    return slice(begin, place + 2 + int(later[0]) if later.size else last)


def _interpolate_locally(t: Array, values: Array, times: Array) -> Array:
    """Return a polynomial through values (L, n) at other times (m, n)."""
    centre, half = float(times.mean()), max(float(np.ptp(t)) / 2.0, 1e-12)
    # Degree of the polynomial; a sine at the cutoff makes less than one turn in its window.
    degree = min(5, t.size - 1)
    fit = np.linalg.lstsq(np.vander((t - centre) / half, degree + 1), values, rcond=None)[0]
    return np.asarray(np.vander((times - centre) / half, degree + 1) @ fit)
