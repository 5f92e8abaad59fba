"""Assembly of a recording: files of one quantity each, columns of a log, what a sheet changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.position_servo import PER_JOINT, PositionServo
from asbuilt.errors import RecordingError
from asbuilt.experiment.command.magnitude import sign_by_command
from asbuilt.experiment.command.servo_torque import drive_by_command
from asbuilt.experiment.logs.columns.layout import Layout
from asbuilt.experiment.logs.columns.roles import parse_file_quantity, recognise
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.options import ReadingOptions
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

_QUANTITIES = {"position", "velocity", "acceleration", "torque"}


def group_by_role(paths: Sequence[Path]) -> list[list[Path]]:
    """Group files whose names differ in the quantity alone, in the order of first appearance."""
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for path in paths:
        quantity, rest = parse_file_quantity(path.stem)
        key = (path.parent, rest, path.suffix) if quantity in _QUANTITIES else (path, "", "")
        groups.setdefault(key, []).append(path)
    result: list[list[Path]] = []
    for group in groups.values():
        distinct = {parse_file_quantity(path.stem)[0] for path in group}
        result.extend([group] if len(distinct) == len(group) else [[path] for path in group])
    return result


def merge_role_files(tables: Mapping[str, LogTable]) -> LogTable:
    """Join files of one quantity each at equal time stamps.

    A key names the quantity, or is a file name that ends in it. Columns whose names give no
    quantity are joints of the file's quantity.

    Raises
    ------
    RecordingError
        If the files have different clocks, or lengths without a clock.
    """
    columns: dict[str, NDArray[np.float64]] = {}
    known: dict[str, tuple[str, str]] = {}
    parts = {}
    for key, table in tables.items():
        quantity = key if key in _QUANTITIES else parse_file_quantity(Path(key).stem)[0]
        if quantity is None:
            raise RecordingError(
                f"the name {key!r} does not name the quantity that the file holds",
                cure=Cure("list the files under [files] in a recording sheet"),
                file=key,
            )
        parts[quantity] = table
    clocks = {quantity: _find_clock_column(table) for quantity, table in parts.items()}
    rows, notes = _match_rows(parts, clocks)
    for quantity, table in parts.items():
        for name, values in table.columns.items():
            if name == clocks[quantity]:
                columns.setdefault("time", values[rows[quantity]])
                continue
            role = recognise(name)
            if role is not None and role.quantity == quantity and not role.joint:
                columns[name] = values[rows[quantity]]
                continue
            key = f"{quantity}/{name}"
            columns[key] = values[rows[quantity]]
            known[key] = (
                quantity,
                name if role is None or role.quantity == "time" else role.joint or name,
            )
    source = ", ".join(table.source for table in parts.values())
    return LogTable(
        source=source,
        columns=columns,
        known=known,
        notes=(*(note for table in parts.values() for note in table.notes), *notes),
    )


def _find_clock_column(table: LogTable) -> str | None:
    for name in table.columns:
        role = recognise(name)
        if role is not None and role.quantity == "time" and not role.joint:
            return name
    return None


def _match_rows(
    parts: Mapping[str, LogTable], clocks: Mapping[str, str | None]
) -> tuple[dict[str, NDArray[np.intp] | slice], tuple[str, ...]]:
    lengths = {table.source: table.n_samples for table in parts.values()}
    times = [
        parts[quantity].columns[clock] for quantity, clock in clocks.items() if clock is not None
    ]
    same = len(set(lengths.values())) == 1
    if same and all(np.array_equal(t, times[0], equal_nan=True) for t in times):
        return dict.fromkeys(parts, slice(None)), ()
    if len(times) < len(parts):
        listing = ", ".join(f"{name}: {length}" for name, length in lengths.items())
        raise RecordingError(
            "files of one recording have different lengths and not all have time stamps to join"
            f" them by ({listing})"
        )
    common = times[0]
    for t in times[1:]:
        common = np.intersect1d(common, t)
    shortest = min(lengths.values())
    if common.size < 0.5 * shortest:
        raise RecordingError(
            f"files of one recording do not share a clock: {common.size} of {shortest} time stamps"
            f" are equal ({', '.join(lengths)})",
            cure=Cure("resample them to one clock, or log all quantities together"),
        )
    rows: dict[str, NDArray[np.intp] | slice] = {}
    for quantity, clock in clocks.items():
        assert clock is not None
        _, index, _ = np.intersect1d(parts[quantity].columns[clock], common, return_indices=True)
        rows[quantity] = index.astype(np.intp)
    return rows, (
        (
            f"{common.size} of {max(lengths.values())} samples have the same time stamp in all"
            " files and were kept"
        ),
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
    notes, start = list(layout.notes), 0.0
    if layout.time is not None:
        t, start = read_logged_times(table, layout, origin)
        if start != 0:
            notes.append(f"times count from {start:.6f} s")
        if rate is not None:
            notes.append(
                f"the rate of {rate:g} Hz was not used: the log has the time column {layout.time!r}"
            )
    elif rate is None:
        raise RecordingError(
            f"{table.source} has no time column and no rate is given; its columns are"
            f" {', '.join(list(table.columns)[:30])}",
            cure=Cure("give the rate in Hz, here or as rate = ... in a recording sheet"),
            file=table.source,
        )
    else:
        t = np.arange(first_sample, first_sample + table.n_samples, dtype=np.float64) / rate
    arrays = {
        quantity: _stack_columns(table, names, layout)
        for quantity, names in layout.quantities.items()
    }
    q, command = arrays.pop("position"), arrays.pop("command", None)
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


def apply_sheet(recording: Recording, sheet: RecordingSheet, options: ReadingOptions) -> Recording:
    """Apply torque source, clock, joint conventions, torque signs, gains and time windows.

    Gain and torque source of the options replace the sheet's; `flip_torque` changes the sign that
    results.
    """
    source = options.torque_source or sheet.torque_source
    if source is not None:
        recording = replace(recording, torque_source=source)
    if sheet.time_factor is not None:
        note = f"times were multiplied by {sheet.time_factor:g}"
        recording = replace(
            recording, t=recording.t * sheet.time_factor, notes=(*recording.notes, note)
        )
    if sheet.position_sign is not None:
        recording = _apply_signs(
            recording, _read_joint_numbers(recording, sheet.position_sign, "position signs")
        )
    if sheet.zero is not None:
        recording = _from_zero(recording, sheet)
    if sheet.sign == "command":
        recording = sign_by_command(recording, {*sheet.lock, *(options.lock or ())})
    elif sheet.sign is not None:
        signs = _read_joint_numbers(recording, sheet.sign, "signs")
        if np.all(signs < 0):
            recording = recording.flipped()
        elif np.any(signs < 0):
            recording = replace(recording.scaled(signs), gains=recording.gains)
    gain = options.gain if options.gain is not None else sheet.gains
    if gain is not None:
        recording = recording.scaled(gain)
    if options.flip_torque:
        recording = recording.flipped()
    if recording.torque_source == "command" and recording.command is not None:
        servo = build_stated_servo(recording, sheet, options)
        if servo is not None:
            recording = drive_by_command(recording, servo)
    if recording.servo is None:
        _refuse_idle_servo(recording, options)
    if sheet.windows:
        inside = sheet.in_windows(recording.t, float(recording.t[0]))
        kept = recording.taken(inside, "no sample lies in the time windows of its sheet")
        note = (
            f"{kept.n_samples} of {recording.n_samples} samples lie in the time windows of the"
            " sheet"
        )
        recording = replace(kept, notes=(*kept.notes, note))
    return recording


def _refuse_idle_servo(recording: Recording, options: ReadingOptions) -> None:
    """Raise if options describe the servo of a recording that has none."""
    given = [name for name in PER_JOINT if getattr(options, name) is not None]
    if not given:
        return
    if recording.command is None:
        problem = "has no commanded positions"
        cure = Cure('name their columns in a recording sheet: [columns] command = ["..."]')
    else:
        problem = f"has torques in addition to its commands (source: {recording.torque_source})"
        cure = Cure("use its commands in their place", settings={"torque_source": "command"})
    raise RecordingError(
        f"{recording.source} {problem}, so that {', '.join(given)} of a servo would have no effect",
        cure=cure,
        file=recording.source,
        value=given,
    )


ABSENT = {"torque_limit": np.inf, "no_load_speed": np.inf, "goal_speed": np.inf, "lead": 0.0}
"""What a servo is taken to lack unless it is stated, as the number that says so."""


def _read_joint_numbers(recording: Recording, given: float | list[float], what: str) -> Array:
    """Return the numbers of a sheet, one or (n,); raise where there are not as many as joints."""
    numbers = np.atleast_1d(np.asarray(given, dtype=np.float64))
    if numbers.size not in (1, recording.n_joints):
        raise RecordingError(
            f"{recording.source}: the sheet gives {numbers.size} {what} for {recording.n_joints}"
            " joints",
            cure=Cure("give one, or one per joint"),
            file=recording.source,
            value=numbers.tolist(),
            expected=recording.n_joints,
        )
    return numbers


def _apply_signs(recording: Recording, signs: Array) -> Recording:
    """Return a recording whose motion is multiplied by these signs, one or (n,)."""

    def times(values: Array | None) -> Array | None:
        return None if values is None else values * signs

    listed = ", ".join(f"{value:g}" for value in signs)
    return replace(
        recording,
        q=recording.q * signs,
        qd=times(recording.qd),
        qdd=times(recording.qdd),
        command=times(recording.command),
        notes=(*recording.notes, f"positions were multiplied by {listed}"),
    )


def _from_zero(recording: Recording, sheet: RecordingSheet) -> Recording:
    """Return a recording whose positions count from those that the log gives at zero."""
    assert sheet.zero is not None
    zeros = _read_joint_numbers(recording, sheet.zero, "zero positions")
    listed = ", ".join(f"{value:g}" for value in zeros)
    signs = np.asarray(1.0 if sheet.position_sign is None else sheet.position_sign)
    return replace(
        recording,
        q=recording.q - signs * zeros,
        command=None if recording.command is None else recording.command - signs * zeros,
        notes=(*recording.notes, f"positions count from {listed}"),
    )


def build_stated_servo(
    recording: Recording, sheet: RecordingSheet, options: ReadingOptions
) -> PositionServo | None:
    """Return the servo that options and sheet state; None if the torque itself was commanded.

    That is so where the sheet names torque columns, no command and no gains.
    """
    given = {
        name: getattr(sheet if getattr(options, name) is None else options, name)
        for name in PER_JOINT
    }
    commanded = sheet.columns.command is not None or any(
        each is not None for each in given.values()
    )
    if sheet.columns.torque is not None and not commanded:
        return None
    numbers: dict[str, Any] = {
        name: _spread_over_joints(recording, name, each, ABSENT.get(name, np.nan))
        for name, each in given.items()
    }
    return PositionServo(**numbers)


def _spread_over_joints(
    recording: Recording, name: str, given: Any, unknown: float
) -> tuple[float, ...]:
    """Return one number per joint; "auto", NaN and None are `unknown`, "none" is infinite."""
    listed = given if isinstance(given, list | tuple) else [given]
    named = {None: np.nan, "auto": np.nan, "none": np.inf}
    numbers = [named[each] if each in named else float(each) for each in listed]
    values = [unknown if np.isnan(each) else each for each in numbers]
    if len(values) not in (1, recording.n_joints):
        raise RecordingError(
            f"{recording.source}: {len(values)} values of {name} for {recording.n_joints} joints"
            f" ({', '.join(recording.joint_names)})",
            cure=Cure("give one value, or one per joint"),
            file=recording.source,
            value=len(values),
            expected=recording.n_joints,
        )
    return tuple(values * recording.n_joints if len(values) == 1 else values)


def read_logged_times(
    table: LogTable, layout: Layout, origin: float | None = None
) -> tuple[Array, float]:
    """Return the times [s] of a table with a time column, less the origin, and the origin."""
    assert layout.time is not None
    t = table.columns[layout.time] * layout.scales.get(layout.time, 1.0)
    start = origin if origin is not None else find_clock_origin(t)
    t = t - start if start != 0 else t
    return (
        t if layout.nanoseconds is None else t + 1e-9 * table.columns[layout.nanoseconds],
        start,
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
        factor = layout.scales.get(name, 1.0)
        if not name:
            continue
        if factor == 1.0:
            out[:, k] = table.columns[name]
        else:
            np.multiply(table.columns[name], factor, out=out[:, k])
        if layout.offsets.get(name):
            out[:, k] += layout.offsets[name]
    out.setflags(write=False)  # a recording copies what others could change
    return out
