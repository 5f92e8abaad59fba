"""Pauses of the clock that are shorter than the filter resolves, bridged by local polynomials."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.experiment.recording import Recording


def bridge_pauses(
    recording: Recording, rows: Indices, longest: float, pause: float
) -> tuple[Recording, Indices, tuple[float, ...]]:
    """Return a recording whose shorter pauses are filled, its rows, and the lengths of these.

    Parameters
    ----------
    recording, rows
        The recording and its usable rows.
    longest
        Longest pause [s] that is filled.
    pause
        Steps of the clock [s] from which there is a pause.

    Notes
    -----
    Every channel is fitted by a polynomial of degree 5 in least squares, over as many samples on
    either side as are missing, and at least 8: an interpolating spline would continue the slope of
    the noise. A command is held.
    """
    steps = np.diff(recording.t[rows])
    places = np.flatnonzero((steps > pause) & (steps <= longest))
    if not places.size:
        return recording, rows, ()
    period = float(np.median(steps))
    names = [
        name
        for name in ("q", "tau", "qd", "qdd", "command")
        if getattr(recording, name) is not None
    ]
    t = recording.t[rows]
    columns = {name: getattr(recording, name)[rows] for name in names}
    before = 0
    parts: dict[str, list[Array]] = {name: [] for name in ("t", *names)}
    for place in places.tolist():
        count = round(float(steps[place]) / period) - 1
        times = t[place] + np.arange(1, count + 1) * (steps[place] / (count + 1))
        near = _select_around(t, place, count, pause)
        parts["t"] += [t[before : place + 1], times]
        for name in names:
            if name == "command":
                filled = np.repeat(columns[name][place : place + 1], count, axis=0)
            else:
                filled = _interpolate_locally(t[near], columns[name][near], times)
            parts[name] += [columns[name][before : place + 1], filled]
        before = place + 1
    parts["t"].append(t[before:])
    for name in names:
        parts[name].append(columns[name][before:])
    whole = {name: np.concatenate(each) for name, each in parts.items()}
    filled_in = replace(recording, **cast(Any, whole), qdd=None, extra={})
    return filled_in, np.arange(whole["t"].size), tuple(steps[places].tolist())


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
