"""Assembly of a recording: files of one quantity each, columns of a log, what a sheet changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.command.magnitude import sign_by_command
from asbuilt.experiment.command.torque import drive_as_stated
from asbuilt.experiment.logs.columns.layout import Layout
from asbuilt.experiment.logs.columns.roles import (
    find_nanoseconds,
    parse_file_quantity,
    recognise,
    split_unit,
)
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.reading_options import ReadingOptions
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import ENCODERS, Recording, spread_over_joints
from asbuilt.findings import Cure

FILE_QUANTITIES = {"position", "velocity", "acceleration", "torque"}
"""Quantities that may have a file of their own."""


def merge_role_files(tables: Mapping[str, LogTable]) -> LogTable:
    """Join files of one quantity each at equal time stamps.

    A key names the quantity, or is a file name that ends in it. Columns whose names give no
    quantity are joints of the file's quantity.

    Raises
    ------
    RecordingError
        If the files have different clocks, or lengths without a clock.
    """
    columns: dict[str, Array] = {}
    known: dict[str, tuple[str, str]] = {}
    parts: dict[str, LogTable] = {}
    for key, table in tables.items():
        quantity = key if key in FILE_QUANTITIES else parse_file_quantity(Path(key).stem)[0]
        if quantity is None:
            raise RecordingError(
                f"the name {key!r} does not name the quantity that the file holds",
                cure=Cure("list the files under [files] in a recording sheet"),
                file=key,
            )
        parts[quantity] = table
    clocks = {quantity: _find_clock(table) for quantity, table in parts.items()}
    times = {
        quantity: _read_clock(parts[quantity], clock) for quantity, clock in clocks.items() if clock
    }
    rows, notes = _match_rows(parts, times)
    if times:
        first = next(iter(times))
        columns = {name: parts[first].columns[name][rows[first]] for name in clocks[first]}
    for quantity, table in parts.items():
        for name, values in table.columns.items():
            if name in clocks[quantity] or _is_clock(name):
                continue
            role = recognise(name)
            if role is not None and role.quantity == quantity and not role.joint:
                columns[name] = values[rows[quantity]]
            else:
                columns[f"{quantity}/{name}"] = values[rows[quantity]]
                bare = split_unit(name, quantity)[0]
                joint = bare if role is None else role.joint or bare
                known[f"{quantity}/{name}"] = (quantity, joint)
    return LogTable(
        source=", ".join(table.source for table in parts.values()),
        columns=columns,
        known=known,
        notes=(*(note for table in parts.values() for note in table.notes), *notes),
    )


def _is_clock(name: str) -> bool:
    role = recognise(name)
    return role is not None and role.quantity == "time" and not role.joint


def _find_clock(table: LogTable) -> tuple[str, ...]:
    """Return the column of a table's clock, with that of its nanoseconds if it counts seconds."""
    clock = next((name for name in table.columns if _is_clock(name)), None)
    if clock is None:
        return ()
    nanoseconds = find_nanoseconds(clock, list(table.columns))
    return (clock,) if nanoseconds is None else (clock, nanoseconds)


def _read_clock(table: LogTable, clock: tuple[str, ...]) -> Array:
    """Return the times [s] of a clock and its nanoseconds, by which rows of files are matched."""
    stamps, *nanoseconds = (table.columns[name] for name in clock)
    role = recognise(clock[0])
    seconds = stamps * (1.0 if role is None else role.scale)
    # Of clocks in two units the last bits differ: 290 ms are not 0.29 s.
    return _round_digits(seconds + 1e-9 * nanoseconds[0] if nanoseconds else seconds)


def _round_digits(x: Array) -> Array:
    """Return numbers with the decimal digits that a double holds."""
    size = np.where(np.isfinite(x), np.maximum(np.abs(x), 1e-15), 1.0)
    unit = 10.0 ** (np.finfo(np.float64).precision - 1 - np.floor(np.log10(size)))
    return np.asarray(np.round(x * unit) / unit)


def _match_rows(
    parts: Mapping[str, LogTable], times: Mapping[str, Array]
) -> tuple[dict[str, NDArray[np.intp] | slice], tuple[str, ...]]:
    """Return the rows of each file that are of the same times, and notes."""
    lengths = {table.source: table.n_samples for table in parts.values()}
    first = next(iter(times.values()), np.zeros(0))
    alike = all(np.array_equal(t, first, equal_nan=True) for t in times.values())
    if alike and len(set(lengths.values())) == 1:
        return dict.fromkeys(parts, slice(None)), ()
    common = reduce(np.intersect1d, times.values(), first)
    shortest = min(lengths.values())
    listing = ", ".join(f"{name}: {length}" for name, length in lengths.items())
    if len(times) < len(parts):
        raise RecordingError(
            "files of one recording have different lengths and not all have time stamps to join"
            f" them by ({listing})"
        )
    if common.size < 0.5 * shortest:
        raise RecordingError(
            f"files of one recording do not share a clock: {common.size} of {shortest} time stamps"
            f" are equal ({', '.join(lengths)})",
            cure=Cure("resample them to one clock, or log all quantities together"),
        )
    rows = {
        name: np.intersect1d(t, common, return_indices=True)[1].astype(np.intp)
        for name, t in times.items()
    }
    return {**rows}, (
        f"{common.size} of {max(lengths.values())} samples have the same time stamp in all files"
        " and were kept",
    )


def build_recording(
    table: LogTable,
    layout: Layout,
    *,
    rate: float | None,
    first_sample: int = 0,
    origin: float | None = None,
) -> Recording:
    """Put the columns of a table in joint order and SI units, and make the clock.

    Times come from the time column, or follow from `rate` [Hz] and the index `first_sample` of
    the first row. Times after 1e6 s (a calendar's) count from `origin`, by default the first.

    Raises
    ------
    RecordingError
        If there is neither a time column nor a rate.
    """
    notes = list(layout.notes)
    start = 0.0
    stands = layout.time is not None and rate is not None and _stands_still(table, layout)
    if stands:
        notes.append(f"the time column {layout.time!r} stands still, so that the rate was used")
    if layout.time is not None and not stands:
        t = table.columns[layout.time] * layout.scales.get(layout.time, 1.0)
        start = find_clock_origin(t) if origin is None else origin
        t = t - start if start else t
        if layout.nanoseconds is not None:
            t = t + 1e-9 * table.columns[layout.nanoseconds]
        if start:
            notes.append(f"times count from {start:.6f} s")
        if rate is not None:
            notes.append(
                f"the rate of {rate:g} Hz was not used: the log has the time column {layout.time!r}"
            )
    elif rate is None:
        # Columns that have a meaning are no times.
        others = [name for name in table.columns if name not in layout.columns][:30]
        listed = f"; columns without a meaning are {', '.join(others)}" if others else ""
        raise RecordingError(
            f"{table.source} has no time column and no rate is given{listed}",
            cure=Cure(
                "give the rate in Hz, or write rate = ... in a recording sheet",
                settings={"rate": "HZ"},
            ),
            file=table.source,
        )
    else:
        t = np.arange(first_sample, first_sample + table.n_samples, dtype=np.float64) / rate
    arrays = {
        quantity: _stack_columns(table, names, layout)
        for quantity, names in layout.quantities.items()
    }
    q = arrays.pop("position")
    command = arrays.pop("command", None)
    tau = arrays.pop("torque", None)
    return Recording(
        t=t,
        q=q,
        tau=np.zeros_like(q) if tau is None else tau,
        qd=arrays.pop("velocity", None),
        qdd=arrays.pop("acceleration", None),
        joint_names=layout.joint_names,
        source=table.source,
        torque_source="command" if tau is None else layout.torque_source,
        notes=tuple(notes),
        extra=arrays,
        command=command,
        started=start,
    )


def _stands_still(table: LogTable, layout: Layout) -> bool:
    """Return whether no time stamp differs from the first, as where too few digits were kept."""
    times = table.columns[str(layout.time)]
    whole = layout.nanoseconds is None
    return whole and times.size > 1 and bool(np.all(times == times[0]))


def apply_sheet(recording: Recording, sheet: RecordingSheet, options: ReadingOptions) -> Recording:
    """Apply torque source, clock, joint conventions, torque signs and gains.

    Gain and torque source of the options replace the sheet's; `flip_torque` changes the sign that
    results.
    """
    recording = replace(
        recording,
        torque_source=options.torque_source or sheet.torque_source or recording.torque_source,
        stated=_list_stated(sheet, options),
    )
    if sheet.time_factor is not None:
        note = f"times were multiplied by {sheet.time_factor:g}"
        recording = replace(
            recording, t=recording.t * sheet.time_factor, notes=(*recording.notes, note)
        )
    if sheet.position_sign is not None or sheet.zero is not None:
        recording = _apply_conventions(recording, sheet)
    if sheet.sign == "command":
        recording = sign_by_command(recording, {*sheet.lock, *(options.lock or ())})
    elif sheet.sign is not None:
        recording = _turn_torques(recording, spread_over_joints(recording, sheet.sign, "signs"))
    gain = options.gain if options.gain is not None else sheet.gains
    recording = recording if gain is None else recording.scaled(gain)
    recording = recording.flipped() if options.flip_torque else recording
    return drive_as_stated(recording, sheet, options)


def _turn_torques(recording: Recording, signs: Array) -> Recording:
    """Return the recording with torques times signs (n,), also the extra ones of each joint."""
    if np.all(signs < 0):
        return recording.flipped()
    if np.all(signs > 0):
        return recording
    extra = {
        name: values * signs
        if name.startswith("tau") and values.shape == recording.q.shape
        else values
        for name, values in recording.extra.items()
    }
    return replace(recording.scaled(signs), extra=extra, gains=recording.gains)


def _list_stated(sheet: RecordingSheet, options: ReadingOptions) -> frozenset[str]:
    """Return what of the log is stated, by `Recording.stated`."""
    given = {
        "position": sheet.units.position is not None or bool(sheet.joint_units),
        "torque": (sheet.units.torque, sheet.gains, options.gain) != (None, None, None),
        "sign": sheet.sign is not None or options.flip_torque,
        "zero": (sheet.zero, sheet.position_sign) != (None, None),
    }
    return frozenset(name for name, is_stated in given.items() if is_stated)


def keep_windows(recording: Recording, sheet: RecordingSheet) -> Recording:
    """Return the samples in the time windows of the sheet, which count from the first sample."""
    if not sheet.windows:
        return recording
    inside = sheet.in_windows(recording.t, float(recording.t[0]))
    kept = recording.taken(inside, "no sample lies in the time windows that are kept")
    note = f"{kept.n_samples} of {inside.size} samples lie in the time windows that are kept"
    return replace(kept, notes=(*kept.notes, note))


def _apply_conventions(recording: Recording, sheet: RecordingSheet) -> Recording:
    """Return the recording with positions in the direction and from the zero of the description."""
    one = sheet.position_sign is None
    none = sheet.zero is None
    signs = spread_over_joints(recording, 1.0 if one else sheet.position_sign, "position signs")
    zeros = spread_over_joints(recording, 0.0 if none else sheet.zero, "zero positions")
    notes = tuple(
        f"positions {what} {', '.join(f'{value:g}' for value in np.atleast_1d(given))}"
        for what, given in (
            ("were multiplied by", sheet.position_sign),
            ("count from", sheet.zero),
        )
        if given is not None
    )

    def turn(values: Array | None) -> Array | None:
        return None if values is None else values * signs

    def convert(positions: Array) -> Array:
        return positions * signs - signs * zeros

    encoders = {
        name: convert(values)
        for name, values in recording.extra.items()
        if name in ENCODERS.values()
    }
    return replace(
        recording,
        q=convert(recording.q),
        qd=turn(recording.qd),
        qdd=turn(recording.qdd),
        command=None if recording.command is None else convert(recording.command),
        extra={**recording.extra, **encoders},
        notes=(*recording.notes, *notes),
    )


def find_clock_origin(t: Array) -> float:
    """Return the first time of a clock that counts from a date, else zero."""
    finite = t[np.isfinite(t)]
    # Time [s] from which a clock counts from a date, not from the start of the recording.
    return float(finite[0]) if finite.size and abs(finite[0]) > 1e6 else 0.0


def _stack_columns(table: LogTable, names: tuple[str, ...], layout: Layout) -> Array:
    """Return columns in SI units (N, n), NaN for joints that have none."""
    out = np.full((table.n_samples, len(names)), np.nan)
    for k, name in enumerate(names):
        if name:
            np.multiply(table.columns[name], layout.scales.get(name, 1.0), out=out[:, k])
        if layout.offsets.get(name):
            out[:, k] += layout.offsets[name]
    out.setflags(write=False)  # a recording copies what others could change
    return out
