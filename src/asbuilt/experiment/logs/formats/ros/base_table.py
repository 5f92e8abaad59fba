"""Columns of a floating base at the times of the joint states, from topics of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.curves import CubicSpline
from asbuilt.experiment.logs.formats.log_format import LogTable, hold_last, measure_gaps
from asbuilt.experiment.logs.formats.ros.messages import (
    FLAG,
    SPARSE,
    JointMessage,
    Topics,
    is_stamped,
    name_contact,
    read_times,
)

SLOWER = 1.05
"""Ratio of periods from which a topic is slower than another, not as fast with some jitter."""


def add_base_states(
    table: LogTable,
    topics: Topics,
    messages: Mapping[str, list[JointMessage]],
    states: list[JointMessage],
) -> LogTable:
    """Return the table with columns of the base at the times of the joint states.

    Between two messages values follow a cubic spline; before the first, after the last, and
    where messages are missing they are NaN. Flags hold until the next one. A topic that is much
    slower than the joint states is left out, and the table says why in `unread`.

    Parameters
    ----------
    table
        One row for each joint state.
    topics
        The file and its topics.
    messages
        Messages of each topic of the base.
    states
        The joint states.
    """
    columns = dict(table.columns)
    unread = dict(topics.unread)
    notes = list(table.notes)
    for topic, found in messages.items():
        both = is_stamped(states) and is_stamped(found)
        rows = read_times(states, both)
        times, first = np.unique(read_times(found, both), return_index=True)
        names = max((each.names for each in found), key=len)
        complete = np.array([found[k].names == names for k in first])
        values = np.array([found[k].position for k in first[complete]])
        if topics.types[topic] == FLAG:
            columns[f"contact_{name_contact(topic)}"] = hold_last(rows, times, values[:, 0])[0]
            continue
        group = "_".join(names[0].split("_")[:-1]) if names else "imu"
        period, own = (_measure_period(each) for each in (times[complete], rows))
        rates = f"{topic} has {1e9 / period:.3g} Hz and the joint states {1e9 / own:.3g} Hz"
        sampled = resample(rows, times[complete], values, names, period)
        if not np.isfinite(sampled).any():
            unread[group] = (
                f"{topics.path}: {topic} has no value at the time of any joint state",
                "record both by one clock, and what the sensor measures",
            )
        elif period > SPARSE * own:
            unread[group] = (
                f"{topics.path}: {rates}, so that how the base moves between its messages is not"
                " in the log",
                f"record it at {1e9 / (SPARSE * own):.3g} Hz or faster, or another source",
            )
        else:
            columns |= zip(names, sampled.T, strict=True)
            if period > SLOWER * own:
                notes.append(f"{rates}: motion above {0.5e9 / period:.3g} Hz is not in it")
    known = {name: table.known.get(name, ("", "")) for name in columns if name != "time"}
    return replace(table, columns=columns, known=known, unread=unread, notes=tuple(notes))


def _measure_period(times: NDArray[np.int64]) -> float:
    """Return the median time between messages [ns], at least one; infinite for fewer than two."""
    return max(float(np.median(np.diff(times))), 1.0) if times.size > 1 else np.inf


def resample(
    rows: NDArray[np.int64],
    times: NDArray[np.int64],
    values: Array,
    names: tuple[str, ...],
    period: float,
) -> Array:
    """Return values (N, k) at other times (M,) [ns], NaN where they are unknown, (M, k).

    A quaternion and its opposite are one rotation: signs go on without a jump, and lengths are
    interpolated too, so that one which is not normalised is still seen.
    """
    turn = [
        k for k, name in enumerate(names) if name.rpartition("_")[2] in ("qx", "qy", "qz", "qw")
    ]
    known = np.isfinite(values).all(axis=1)
    times = times[known]
    values = values[known]
    if turn and len(values):
        flips = np.sum(values[1:, turn] * values[:-1, turn], axis=1) < 0.0
        values[1:, turn] *= np.cumprod(np.where(flips, -1.0, 1.0))[:, None]
    out = np.full((rows.size, len(names)), np.nan)
    if len(values) < 4 or not names:
        return out
    after = np.searchsorted(times, rows)
    exact = times[np.minimum(after, times.size - 1)] == rows
    near = measure_gaps(rows, times) <= SPARSE * period
    inside = (rows >= times[0]) & (rows <= times[-1]) & (near | exact)
    start = times[0]
    t = (times - start) * 1e-9
    at = (rows[inside] - start) * 1e-9
    out[inside] = CubicSpline(t, values)(at)
    if turn:
        length = np.interp(at, t, np.linalg.norm(values[:, turn], axis=1))
        found = out[np.ix_(inside, turn)]
        out[np.ix_(inside, turn)] = found * (length / np.linalg.norm(found, axis=1))[:, None]
    out[exact] = values[after[exact]]  # to the last digit
    return out
