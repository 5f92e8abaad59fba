"""Mending of logs whose values are all there: rows of several topics, clocks, counters that wrap.

Each step changes a log only where the result agrees better with itself than what was logged, and
leaves a note with its counts. What is not certain stays, for `check_recording` to find.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.layout import QUANTITIES, Layout
from asbuilt.experiment.logs.formats.log_format import LogTable, measure_gaps
from asbuilt.experiment.recording import ENCODERS, UNWRAPPED
from asbuilt.findings import Cure

OF_TOPICS = 0.05
"""Share of the rows from which rows without any needed value are another topic's: a sensor that
drops out more often is broken, and a merged table of two topics alternates."""
SELDOM = 0.5
"""Share of the rows of the positions in which a column has a value, below which it has its own."""
FEWEST_STEPS = 5.0
"""Median steps of a column over which values are not interpolated: that is a gap."""
REGULAR = (0.4, 2.2, 0.9)
"""Steps, relative to their median, within which a sorted clock is regular, and the share of them:
single samples may be lost, and every second one late by half a step."""
SINGLE = 0.01
"""Share of doubled stamps up to which a clock is left as it is; filters leave the rows out."""
DOUBLED = 0.2
"""Share of doubled stamps up to which their second rows are left out: more are a clock too coarse,
or several motions one after another."""
GRID = 0.75
"""Distance from a regular grid, in steps of a rounded clock, up to which that is its grid."""
JUMP = 0.6
SMALL = 0.15
"""Jump of a counter that wraps, and the largest step that is left then, in turns."""
MOST = 1e12
"""Size of a value, in any unit, beyond which it stands for none: loggers write the largest number
of a type, 3.4e38 or 1.8e308, where a sensor says nothing."""
LATEST = 1e20
"""Largest time stamp, in any unit: nanoseconds since 1970 have 19 digits."""
FEWEST_ROWS = 3
"""Rows by which a part of a log may be judged."""
ZERO = 0.02
"""Distance from one turn, relative to it, up to which the range of a counter is a turn."""


@dataclass(frozen=True, slots=True)
class _Counter:
    """Say where a column goes on: its period, 0 if it does not wrap, its last value and turns."""

    period: float
    last: float
    turns: float = 0.0


@dataclass(frozen=True, slots=True)
class Mended:
    """Say what was mended, and how often: the count adds up over the parts of a log.

    `kind` names what was done. The text of the first part stands for all; in it `{count}` and
    `{rows}` are the count and the number of all rows.
    """

    kind: str
    count: int
    text: str

    def write(self, rows: int) -> str:
        """Return the note on a log of so many rows."""
        return self.text.replace("{count}", str(self.count)).replace("{rows}", str(rows))


class LogMender:
    """Mend the tables of one log, which may come in consecutive parts.

    The notes of a part count what was mended up to its end, so that those of the last part are
    those of the log.

    Parameters
    ----------
    layout
        Columns of the log.
    zero
        Logged position [rad] at which the description has zero, of all joints or of each: a counter
        that wraps is the nearest turn to it.
    """

    def __init__(self, layout: Layout, zero: object = None) -> None:
        self._layout = layout
        self._zero = zero
        self._wide: set[tuple[int, str]] = set()
        self._counters: dict[str, _Counter] = {}
        self._jumps: dict[float, dict[str, int]] = {}
        self._latest: float | None = None
        self._began: float | None = None
        self._step: float | None = None
        self._until = 0.0
        self._rounded = 0.0
        self._mended: dict[str, Mended] = {}
        # Rows so far: without those of other topics, and all.
        self._rows = [0, 0]

    def mend(self, table: LogTable) -> LogTable:
        """Return a table with rows of one topic, in the order of time, and steady counters."""
        mended: list[Mended] = []
        kept = table
        if table.n_samples >= FEWEST_ROWS:
            kept, mended = self._mend_rows(table)
        elif self._step is not None:
            kept = self._continue_clock(table)
        columns = dict(kept.columns)
        # Fewer rows say nothing by themselves: for them holds what the parts before have said.
        if any(self._rows):
            mended += self._sign(columns)
            self._unwrap(columns)
        for part in mended:
            first = self._mended.setdefault(part.kind, replace(part, count=0))
            self._mended[part.kind] = replace(first, count=first.count + part.count)
        return replace(kept, columns=columns, notes=(*table.notes, *self._list_notes()))

    def _mend_rows(self, table: LogTable) -> tuple[LogTable, list[Mended]]:
        """Return the rows of one topic in the order of time, and what was mended."""
        table, of_values = self._leave_absurd_values(table)
        joined, of_rows = join_topics(table, self._layout)
        if self._began is None and self._layout.time is not None and joined.n_samples:
            self._began = float(joined.columns[self._layout.time][0])
        later = self._leave_late_rows(joined)
        self._rows = [self._rows[0] + joined.n_samples, self._rows[1] + table.n_samples]
        if self._step is not None and np.unique(_read_stamps(later, self._layout)).size == 1:
            return self._continue_clock(later), [*of_values, *of_rows]
        ordered, of_clock = mend_clock(later, self._layout, self._began, self._step)
        if of_clock:
            stamps = _read_stamps(ordered, self._layout)
            self._latest = float(stamps[-1])
            if of_clock[0].kind == "grid":
                self._latest = None
                self._until = float(stamps[-1])
                self._rounded = float(np.ptp(_read_stamps(later, self._layout) - stamps))
                self._step = self._scale * float(stamps[-1] - stamps[0]) / (stamps.size - 1)
        return ordered, [*of_values, *of_rows, *of_clock]

    @property
    def _scale(self) -> float:
        """Seconds of a unit of the clock."""
        return self._layout.scales.get(str(self._layout.time), 1.0)

    def _continue_clock(self, table: LogTable) -> LogTable:
        """Return rows whose few stamps are rounded at the clock behind those of the part before."""
        stamps = _read_stamps(table, self._layout)
        if _is_dated(stamps[0] * self._scale):
            stamps = stamps - (self._began or 0.0)
        step = (self._step or 0.0) / self._scale
        begin = self._until + step
        if stamps[0] > begin + self._rounded:  # there is a gap between the parts
            begin = float(stamps[0])
        times = begin + step * np.arange(stamps.size, dtype=np.float64)
        self._until = float(times[-1])
        columns = dict(table.columns)
        columns[str(self._layout.time)] = times
        if self._layout.nanoseconds is not None:
            columns[self._layout.nanoseconds] = np.zeros(stamps.size)
        return replace(table, columns=columns)

    def _list_notes(self) -> Iterator[str]:
        """Yield what was mended so far."""
        for mended in self._mended.values():
            yield mended.write(self._rows[mended.kind == "rows"])
        for period, jumps in self._jumps.items():
            listed = ", ".join(f"{name} {count} times" for name, count in jumps.items())
            yield f"{UNWRAPPED} {period:.6g} were unwrapped: {listed}"

    def _leave_absurd_values(self, table: LogTable) -> tuple[LogTable, list[Mended]]:
        """Return a table without values that no quantity has, as loggers write for "none"."""
        columns = dict(table.columns)
        notes = []
        time = self._layout.time
        if time is not None and not (np.abs(columns[time]) <= LATEST).all():
            # `check_recording` says which time stamps are none.
            columns[time] = np.where(np.abs(columns[time]) <= LATEST, columns[time], np.nan)
            table = replace(table, columns=columns)
        for name in {name for names in self._layout.quantities.values() for name in names if name}:
            if name not in columns:
                continue
            values = columns[name]
            absurd = np.isfinite(values) & ~(np.abs(values) <= MOST)
            if absurd.any():
                first = int(np.argmax(absurd))
                if absurd.mean() > SELDOM:
                    raise RecordingError(
                        f"{table.source}: most values of {name} are none of a joint, such as"
                        f" {values[first]:g} in row {first + 1}; at most {MOST:g} is read",
                        cure=Cure("name another column in a recording sheet, or export it again"),
                        file=table.source,
                    )
                columns[name] = np.where(absurd, np.nan, columns[name])
                text = (
                    f"values of {name} beyond {MOST:g}, such as {values[first]:g} in row"
                    f" {first + 1}, count as missing: {{count}}"
                )
                notes.append(Mended(f"absurd {name}", int(absurd.sum()), text))
        notes.sort(key=lambda note: note.kind)
        return (replace(table, columns=columns), notes) if notes else (table, [])

    def _leave_late_rows(self, table: LogTable) -> LogTable:
        """Return a part without rows that belong into the part before, where that was sorted."""
        if self._latest is None:
            return table
        later = _read_stamps(table, self._layout) > self._latest
        columns = {name: values[later] for name, values in table.columns.items()}
        return replace(table, columns=columns) if later.sum() > 2 else table

    def _sign(self, columns: dict[str, Array]) -> Iterator[Mended]:
        """Turn unsigned integers that stand for negative ones into these."""
        for bits, names in self._list_counted():
            known = any((bits, name) in self._wide for name in names)
            if not known and not any(_is_unsigned(columns[name], bits) for name in names):
                continue
            self._wide |= {(bits, name) for name in names}
            count = 0
            for name in names:
                below = columns[name] >= 2.0 ** (bits - 1)
                count += int(below.sum())
                columns[name] = np.where(below, columns[name] - 2.0**bits, columns[name])
            if count:
                text = (
                    f"{join(names)} are {bits} bits without a sign, which wrap at {2**bits}:"
                    f" {{count}} values from {2 ** (bits - 1)} on count as negative"
                )
                yield Mended(f"sign {names[0]}", count, text)

    def _list_counted(self) -> Iterator[tuple[int, tuple[str, ...]]]:
        """Yield the columns of each quantity that may be integers without a sign, and their bits.

        Positions of 16 bits are counters, which `_unwrap` makes go on.
        """
        for quantity in ("torque", "velocity", "position", "command"):
            names = tuple(name for name in self._layout.quantities.get(quantity, ()) if name)
            if quantity in ("torque", "velocity"):
                yield 16, names
            yield 32, names

    def _unwrap(self, columns: dict[str, Array]) -> None:
        """Make positions of counters that begin again after a turn go on."""
        groups = [
            [name for name in self._layout.quantities.get(quantity, ()) if name]
            for quantity in ("position", "command", *ENCODERS.values())
        ]
        for names in groups:
            period = self._find_period(columns, names)
            for k, name in enumerate(names):
                columns[name], count = self._go_on(name, columns[name], period, k)
                if period is not None and count:
                    jumps = self._jumps.setdefault(period, {})
                    jumps[name] = jumps.get(name, 0) + count

    def _find_period(self, columns: Mapping[str, Array], names: Sequence[str]) -> float | None:
        """Return a turn in the units of columns that wrap, None if none of them does."""
        known = [self._counters[name].period for name in names if name in self._counters]
        if any(known):
            return next(filter(None, known))
        found = [
            period
            for name in names
            for period in _list_turns(columns[name], self._layout.scales.get(name, 1.0))
            if _wraps(columns[name], period)
        ]
        return found[0] if found else None

    def _go_on(
        self, name: str, values: Array, period: float | None, index: int
    ) -> tuple[Array, int]:
        """Return a column unwrapped, from where the part before ended, and the number of jumps."""
        known = np.isfinite(values)
        inside = values[known]
        if not inside.size:
            return values, 0
        before = self._counters.get(name)
        if period is None:
            self._counters[name] = _Counter(0.0, float(inside[-1]))
            return values, 0
        first = inside[0] if before is None else before.last
        turns = -np.round(np.diff(inside, prepend=first) / period)
        total = np.cumsum(turns) + (0.0 if before is None else before.turns)
        if before is None:
            # A turn more or less is the same place: the one nearest to the robot's zero is meant.
            middle = float(np.median(inside + period * total)) - self._find_zero(name, index)
            total -= np.round(middle / period)
        self._counters[name] = _Counter(period, float(inside[-1]), float(total[-1]))
        out = np.array(values)
        out[known] = inside + period * total
        return out, int(np.count_nonzero(turns))

    def _find_zero(self, name: str, index: int) -> float:
        """Return the robot's zero in the unit of a column."""
        zeros = self._zero if isinstance(self._zero, list | tuple) else [self._zero]
        zero = zeros[min(index, len(zeros) - 1)] if zeros else None
        offset = self._layout.offsets.get(name, 0.0)
        scale = self._layout.scales.get(name, 1.0)
        return ((float(zero) if isinstance(zero, int | float) else 0.0) - offset) / scale


def join(names: Sequence[str]) -> str:
    """Return the names of columns in a row, without those in the middle of many."""
    few = names if len(names) < 4 else (names[0], "...", names[-1])
    return ", ".join(few)


def join_topics(table: LogTable, layout: Layout) -> tuple[LogTable, list[Mended]]:
    """Return the rows that hold positions, with what other topics logged between them.

    In a table of several topics each row has the values of one, and the cells of others are empty.
    Columns that are filled in other rows than the positions are interpolated at their times.
    """
    needed = [
        name
        for quantity in QUANTITIES
        for name in layout.quantities.get(quantity, ())
        if name and name in table.columns
    ]
    present = {name: np.isfinite(table.columns[name]) for name in needed}
    filled = np.logical_or.reduce([*present.values()])
    empty = int(np.count_nonzero(~filled))
    positions = [name for name in layout.quantities["position"] if name]
    lead = max(positions, key=lambda name: np.count_nonzero(present[name]))
    rows = present[lead]
    apart = [
        name
        for name in needed
        if np.any(rows) and np.any(present[name]) and np.mean(present[name][rows]) < SELDOM
    ]
    merged = empty >= OF_TOPICS * table.n_samples or (apart and layout.time is not None)
    if not merged or layout.time is None:
        return table, []
    kept = rows if apart else filled
    columns = {name: values[kept] for name, values in table.columns.items()}
    notes = []
    if count := int(np.count_nonzero(~kept)):
        text = "{count} of {rows} rows hold other topics and were left out"
        notes.append(Mended("rows", count, text))
    t = table.columns[layout.time]
    for name in apart:
        own = present[name]
        columns[name] = _interpolate(t[kept], t[own], table.columns[name][own])
    if apart:
        text = (
            f"{join(apart)} were logged in other rows than the positions, and were interpolated"
            f" at the {{count}} times of {lead}"
        )
        notes.append(Mended("apart", int(kept.sum()), text))
    return replace(table, columns=columns), notes


def _interpolate(at: Array, t: Array, values: Array) -> Array:
    """Return values at other times, NaN in gaps and beyond the ends."""
    if t.size < 2:
        return np.full(at.shape, np.nan)
    order = np.argsort(t, kind="stable")
    t = t[order]
    values = values[order]
    out = np.interp(at, t, values, left=np.nan, right=np.nan)
    out[measure_gaps(at, t) > FEWEST_STEPS * float(np.median(np.diff(t)))] = np.nan
    return out


def mend_clock(
    table: LogTable, layout: Layout, began: float | None = None, step: float | None = None
) -> tuple[LogTable, list[Mended]]:
    """Return rows in the order of time, one at a time, and stamps without their rounding.

    `began` is the first stamp of a log that comes in parts, and `step` [s] that of the clock behind
    rounded stamps of an earlier part.

    Rows are sorted only if the sorted clock is regular and the positions then go a shorter way, as
    they do not where a clock was set back between two motions.
    """
    if layout.time is None or table.columns[layout.time].size == 0:
        return table, []
    t = _read_clock(table, layout)
    if not np.all(np.isfinite(t)) or not np.any(steps := np.diff(t)):
        return table, []
    grid = _find_grid(t, _read_stamps(table, layout), step)
    if grid is not None:
        return _with_clock(table, layout, *grid, began)
    backward = int(np.count_nonzero(steps < 0))
    order = np.argsort(t, kind="stable")
    later = np.diff(t[order], prepend=-np.inf) > 0
    doubled = int(np.count_nonzero(~later))
    if not backward and doubled <= SINGLE * t.size:
        return table, []
    q = np.column_stack([table.columns[name] for name in layout.quantities["position"] if name])
    kept = order[later]
    same = np.array_equal(q[order[~later]], q[order[np.flatnonzero(~later) - 1]], equal_nan=True)
    few = doubled <= DOUBLED * t.size or same
    if not few or (backward and not (_is_regular(t[kept]) and _measure_way(q, kept) <= 1.0)):
        return table, []
    notes = []
    if backward:
        text = (
            "{count} times a row was earlier than the row before; the rows were sorted by time, in"
            " which the clock is regular"
        )
        notes.append(Mended("order", backward, text))
    if doubled:
        text = "{count} of {rows} rows have the time stamp of another and were left out"
        notes.append(Mended("doubled", doubled, text))
    return replace(table, columns={k: v[kept] for k, v in table.columns.items()}), notes


def _read_stamps(table: LogTable, layout: Layout) -> Array:
    """Return the time stamps in the unit of their column, with nanoseconds of whole seconds."""
    stamps = table.columns[str(layout.time)]
    if layout.nanoseconds is None:
        return stamps
    return np.asarray(stamps + 1e-9 * table.columns[layout.nanoseconds])


def _read_clock(table: LogTable, layout: Layout) -> Array:
    """Return the times [s] from the first one on."""
    t = table.columns[str(layout.time)]
    t = (t - t[0]) * layout.scales.get(str(layout.time), 1.0)
    if layout.nanoseconds is None:
        return np.asarray(t, dtype=np.float64)
    return np.asarray(t + 1e-9 * table.columns[layout.nanoseconds])


def _is_regular(t: Array) -> bool:
    """Return whether the steps of a rising clock are mostly alike."""
    low, high, share = REGULAR
    steps = np.diff(t)
    usual = float(np.median(steps))  # times, not ratios, are compared: a step may be 1e308 s
    return bool(np.mean((steps > low * usual) & (steps < high * usual)) >= share)


def _measure_way(q: Array, order: Indices) -> float:
    """Return how far positions go in another order of their rows, relative to the one logged."""
    with np.errstate(invalid="ignore", over="ignore"):  # values may be infinite or absurd
        logged, ordered = (float(np.nansum(np.abs(np.diff(x, axis=0)))) for x in (q, q[order]))
    return ordered / logged if logged > 0.0 else 1.0


def _find_grid(
    t: Array, stamps: Array, known_step: float | None = None
) -> tuple[Array, Mended] | None:
    """Return the regular times behind stamps that are rounded, with a note; None if they are not.

    Stamps are rounded where many repeat evenly, or where single precision holds all of them and its
    steps are no small part of the clock's.
    """
    steps = np.diff(t)
    changed = np.flatnonzero(steps > 0) + 1
    if np.any(steps < 0) or changed.size < (8 if known_step is None else 1):
        return None
    rounded = float(np.min(steps[changed - 1]))
    # The first and the last stamp may stand for fewer rows than the others.
    rows = int(changed[-1] - changed[0])
    # A short part has too few stamps for a step of its own.
    alone = known_step is None or changed.size >= 8
    step = float(t[changed[-1]] - t[changed[0]]) / rows if alone else float(known_step or 0.0)
    with np.errstate(over="ignore"):
        single = bool(np.array_equal(stamps, stamps.astype(np.float32)))
    if single:
        rounded = float(np.spacing(np.float32(np.max(np.abs(stamps))))) * float(
            (t[-1] - t[0]) / (stamps[-1] - stamps[0])
        )
    repeated = t.size - 1 - changed.size
    if repeated <= OF_TOPICS * t.size and not (single and rounded > OF_TOPICS * step):
        return None
    grid = step * np.arange(t.size, dtype=np.float64)
    away = t - grid
    middle = 0.5 * float(np.max(away) + np.min(away))
    if float(np.max(np.abs(away - middle))) > GRID * rounded:
        return None
    text = (
        f"the time stamps are rounded to {rounded:.3g} s, {{count}} of {{rows}} repeat; they were"
        f" replaced by the regular clock of {1.0 / step:.6g} Hz behind them"
    )
    # Stamps lie to both sides of the grid behind them, so that parts of a log go on as one.
    return grid + middle, Mended("grid", repeated, text)


def _with_clock(
    table: LogTable, layout: Layout, grid: Array, note: Mended, began: float | None
) -> tuple[LogTable, list[Mended]]:
    """Return the table with other times [s], which count from the first stamp of the log."""
    time = str(layout.time)
    first = table.columns[time][0]
    scale = layout.scales.get(time, 1.0)
    columns = {**table.columns, time: first + grid / scale}
    if _is_dated(first * scale):
        # A date has no digits left for steps: times count from the beginning of the log.
        columns[time] = (first - (first if began is None else began)) + grid / scale
    if layout.nanoseconds is not None:
        columns[layout.nanoseconds] = np.zeros_like(grid)
    return replace(table, columns=columns), [note]


def _is_dated(seconds: float) -> bool:
    """Return whether a clock counts from a date, not from the beginning of a log."""
    return abs(seconds) > 1e6


def _is_unsigned(values: Array, bits: int) -> bool:
    """Return whether integers of some bits stand for small numbers of both signs."""
    known = values[np.isfinite(values)]
    half = 2.0 ** (bits - 1)
    if not known.size or known.min() < 0 or not half <= known.max() < 2.0 * half:
        return False
    middle = (known > 0.5 * half) & (known < 1.5 * half)
    return bool(np.all(known == np.round(known)) and not middle.any() and known.min() < 0.5 * half)


def _list_turns(values: Array, scale: float) -> list[float]:
    """Return what a turn may be in the unit of a column: of its name, else degrees or counts."""
    turns = [2.0 * np.pi / scale]
    if scale != 1.0:
        return turns
    known = values[np.isfinite(values)]
    counts = known.size > 0 and bool(np.all(known == np.round(known)))
    spans = (2.0**k for k in range(8, 25)) if counts else ()
    return [*turns, 360.0, *(span for span in spans if known.max() < span)]


def _wraps(values: Array, turn: float) -> bool:
    """Return whether a column stays within a turn, jumps by one, and else is smooth."""
    known = values[np.isfinite(values)]
    if known.size < 3 or np.ptp(known) > (1.0 + ZERO) * turn:
        return False
    steps = np.diff(known)
    jumps = np.abs(steps) > JUMP * turn
    rest = np.abs(steps - turn * np.round(steps / turn))
    return bool(jumps.any() and np.max(rest) < SMALL * turn and np.max(np.abs(known)) <= 1.1 * turn)
