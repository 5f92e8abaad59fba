"""Rows that come one by one, watched as they come: the events of the log that they make."""

from __future__ import annotations

import json
import os
import select
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from asbuilt.apps.watch import Event, Observed, Observer
from asbuilt.apps.watch.events import find_events
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment import LogTable, ReadingOptions, as_recordings, find_layout, find_sheet
from asbuilt.findings import Cure
from asbuilt.identification import choose_payload_frame

STALLED = 1.0
"""Seconds without a row after which a stream has stalled: a hundred samples of the slowest logger
that an observer of 8 Hz is of use for."""
MOST_BROKEN = 100
"""Rows in a row that cannot be read, from which a stream is broken: half a line at a reconnection
is one, a source that writes something else is all."""
LONGEST_EVENT = 100_000
"""Samples of an event that are kept; a longer one is told in parts."""
STEP = 1e-3
"""Change of a column by which its place and scale are found, in its own unit: small for an angle
in radians, and far above rounding."""
EPOCH = 1e6
"""Time [s] from which a clock counts from an epoch and its first row is taken as zero."""


@dataclass(frozen=True, eq=False)
class RowReader:
    """Turn rows of numbers into time, positions, torques and velocities of the robot's joints.

    The quantities, one after another, are an affine function of the row, as names, units, gains and
    signs of the columns make it: `offset + matrix row`.
    """

    time: int
    time_scale: float
    quantities: tuple[str, ...]
    offset: Array
    matrix: Array

    @classmethod
    def of(
        cls, names: Sequence[str], model: RobotModel, options: ReadingOptions, source: str
    ) -> RowReader:
        """Return the reader of these columns.

        Columns are recognised as in a log, of which one row changes one column at a time. Units
        follow from names and sheet alone, as there are no values yet.

        Raises
        ------
        RecordingError
            If positions, torques or times are missing.
        """
        rows = np.zeros((len(names), len(names)))
        sheet = find_sheet(None, options.sheet)[0]
        table = LogTable(source=source, columns=dict(zip(names, rows.T, strict=True)))
        layout = find_layout(table, sheet=sheet, model=model, has_gains=options.gain is not None)
        if layout.time is None or layout.nanoseconds is not None:
            raise RecordingError(
                f"{source} has no column of time, or its time in two columns; its columns are:"
                f" {', '.join(names)}",
                cure=Cure("give every row its time in one column, such as t in seconds"),
            )
        time = [*names].index(layout.time)
        scale = layout.scales.get(layout.time, 1.0)
        others = np.array([k for k in range(len(names)) if k != time])
        rows = np.zeros((len(names), len(names)))
        rows[:, time] = 0.01 * np.arange(len(names)) / scale
        rows[1 + np.arange(len(others)), others] = STEP
        (probe,) = as_recordings(model, [dict(zip(names, rows.T, strict=True))], options)
        given = {key: getattr(probe, key) for key in ("q", "tau", "qd")}
        found = {key: values for key, values in given.items() if values is not None}
        values = np.hstack([*found.values()])
        matrix = np.zeros((values.shape[1], len(names)))
        matrix[:, others] = (values[1:] - values[0]).T / STEP
        return cls(time, scale, tuple(found), values[0], matrix)

    def read(self, row: Array) -> tuple[float, dict[str, Array]]:
        """Return the time [s] of a row, and its quantities."""
        whole = self.offset + self.matrix @ row
        parts = whole.reshape(len(self.quantities), -1)
        return float(row[self.time]) * self.time_scale, dict(
            zip(self.quantities, parts, strict=True)
        )


def read_lines(source: int, tell: Callable[[str], None]) -> Iterator[str]:
    """Yield the lines of a file descriptor as they come, and tell of pauses and a torn end."""
    rest = b""
    stalled = False
    while True:
        if not select.select([source], [], [], STALLED)[0]:
            if not stalled:
                tell(f"no row for {STALLED:g} s: the stream has stalled")
            stalled = True
            continue
        read = os.read(source, 65536)
        if not read:
            break
        if stalled:
            tell("the stream goes on")
        stalled = False
        *lines, rest = (rest + read).split(b"\n")
        yield from (line.decode("utf-8", "replace") for line in lines)
    if rest.strip():
        tell("the stream ended within a row")


@dataclass
class StreamedRows:
    """Read rows of numbers from lines: CSV with a header, or JSON objects with the same keys."""

    lines: Iterator[str]
    tell: Callable[[str], None]
    names: tuple[str, ...] = ()
    broken: int = 0
    _bad: int = 0
    _number: int = 0

    def __iter__(self) -> Iterator[Array]:
        """Yield rows (m,) in the order of `names`, which the first line gives.

        Raises
        ------
        RecordingError
            If nothing came, or hundreds of lines together cannot be read.
        """
        for line in self.lines:
            self._number += 1
            text = line.strip()
            if not text:
                continue
            if not self.names and not text.startswith("{"):
                self.names = tuple(name.strip().strip('"') for name in text.split(","))
                continue
            row = self._parse(text)
            if row is not None:
                yield row
        if not self.names:
            raise RecordingError(
                "nothing came from standard input",
                cure=Cure("write a header and rows of CSV, or one JSON object a line"),
            )

    def _parse(self, text: str) -> Array | None:
        try:
            if text.startswith("{"):
                content = _flatten(json.loads(text))
                self.names = self.names or tuple(content)
                values = [float(content[name]) for name in self.names]
            else:
                values = [float(cell) if cell.strip() else np.nan for cell in text.split(",")]
            if len(values) != len(self.names):
                raise ValueError(f"{len(values)} numbers for {len(self.names)} columns")
        except (ValueError, KeyError, TypeError, RecursionError) as problem:
            self._count_broken(f"{type(problem).__name__} {problem}"[:80])
            return None
        self._bad = 0
        return np.array(values)

    def _count_broken(self, why: str) -> None:
        self.broken += 1
        self._bad += 1
        if self._bad == 1:
            self.tell(f"line {self._number} cannot be read ({why})")
        if self._bad >= MOST_BROKEN:
            raise RecordingError(
                f"{MOST_BROKEN} lines together cannot be read, the last is number {self._number}:"
                f" {why}",
                cure=Cure("write rows of CSV under one header, or one JSON object a line"),
            )


def _flatten(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object with the entries of its lists as `name_0`, `name_1`, ...

    >>> _flatten({"t": 0.5, "q": [1.0, 2.0]})
    {'t': 0.5, 'q_0': 1.0, 'q_1': 2.0}
    """
    flat: dict[str, Any] = {}
    for name, value in content.items():
        each = {f"{name}_{k}": item for k, item in enumerate(value)} if (
            isinstance(value, list)
        ) else {name: value}  # fmt: skip
        flat |= each
    return flat


@dataclass
class StreamWatch:
    """Watch samples one by one.

    Parameters
    ----------
    observer
        The observer, with thresholds.
    frame
        Link or frame at which forces are given; None: the flange.
    begun
        Called with the first sample beyond a threshold: time, joint, residual and threshold.
    ended
        Called with the event when it is over.
    """

    observer: Observer
    frame: str | None
    begun: Callable[[float, str, float, float], None]
    ended: Callable[[Event], None]
    n_samples: int = 0
    left_out: int = 0
    n_events: int = 0
    _rows: list[tuple[Any, ...]] = field(default_factory=list)
    _last: float = -np.inf
    _time: float = -np.inf

    def __post_init__(self) -> None:
        name, link, placement = choose_payload_frame(self.observer.model, self.frame)
        self.frame = name
        self._tool = link, placement

    def take(self, t: float, q: Array, tau: Array, qd: Array | None) -> None:
        """Take one sample; one that is not finite, or not later than the last, is left out."""
        given = (q, tau) if qd is None else (q, tau, qd)
        if not (t > self._time and all(np.isfinite(x).all() for x in given)):
            self.left_out += 1
            return
        observer = self.observer
        self._time = t
        observer.update(t, q, tau, qd)
        self.n_samples += 1
        self._follow(t)

    def finish(self) -> None:
        """End an event that goes on."""
        if self._rows:
            self._end()

    def _follow(self, t: float) -> None:
        see = self.observer
        if self._rows and t - self._last > see.limits.block_seconds:
            self._end()
        # The error of the model only raises a limit, and takes most of the time: most samples are
        # below the limit without it.
        beyond = bool((np.abs(see.residual) > see.least_threshold).any()) and bool(see.alarms)
        if beyond and not self._rows:
            limit = see.threshold
            k = int(np.argmax(np.abs(see.residual) / limit))
            self.begun(t, see.model.joint_names[k], float(see.residual[k]), float(limit[k]))
        if beyond or self._rows:
            self._rows.append(
                (t, see.q, see.qd, see.qdd, see.step, see.unknown_friction, see.residual,
                 see.slowness)
            )  # fmt: skip
        if beyond:
            self._last = t
        if len(self._rows) >= LONGEST_EVENT:
            self._end()

    def _end(self) -> None:
        times, *arrays = zip(*self._rows, strict=True)
        q, qd, qdd, step, unknown, residual, slowness = map(np.array, arrays)
        observed = Observed(
            np.array(times), np.zeros(len(times)), q, qd, qdd, step, unknown, residual
        )
        thresholds = self.observer.limits
        error = self.observer.model_error.std(q, qd, qdd)
        scale = thresholds.scale(qd, slowness, error)
        limit = thresholds.limit(qd, slowness, step, unknown, error)
        self._rows.clear()
        for event in find_events(self.observer, observed, scale, limit, self._tool):
            self.n_events += 1
            self.ended(event)


def watch_stream(
    lines: Iterator[str],
    watching: StreamWatch,
    tell: Callable[[str], None],
    options: ReadingOptions | None = None,
) -> StreamedRows:
    """Watch the rows of lines as they come; return what was read.

    Raises
    ------
    RecordingError
        If the stream has no positions, torques or times, no velocities where the thresholds need
        them, or cannot be read.
    """
    rows = StreamedRows(lines, tell)
    reader = None
    origin = 0.0
    chosen = replace(options or ReadingOptions(), rate=None)
    filtered = watching.observer.limits.filtered
    for row in rows:
        if reader is None:
            reader = RowReader.of(rows.names, watching.observer.model, chosen, "standard input")
            if not filtered and "qd" not in reader.quantities:
                raise RecordingError(
                    "the stream has no velocities, but the thresholds were set with logged ones",
                    cure=Cure("stream velocities, or set the thresholds on logs without them"),
                )
            first = reader.read(row)[0]
            origin = first if first > EPOCH else 0.0
        t, found = reader.read(row)
        watching.take(t - origin, found["q"], found["tau"], None if filtered else found["qd"])
    watching.finish()
    return rows
