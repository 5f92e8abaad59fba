"""Recordings in several files of one quantity each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.roles import quantity_of_file, recognise
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.findings import Cure

_QUANTITIES = {"position", "velocity", "acceleration", "torque"}


def role_groups(paths: Sequence[Path]) -> list[list[Path]]:
    """Group files whose names differ in the quantity alone, in the order of first appearance."""
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for path in paths:
        quantity, rest = quantity_of_file(path.stem)
        key = (path.parent, rest, path.suffix) if quantity in _QUANTITIES else (path, "", "")
        groups.setdefault(key, []).append(path)
    result: list[list[Path]] = []
    for group in groups.values():
        distinct = {quantity_of_file(path.stem)[0] for path in group}
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
        quantity = key if key in _QUANTITIES else quantity_of_file(Path(key).stem)[0]
        if quantity is None:
            raise RecordingError(
                f"the name {key!r} does not name the quantity that the file holds",
                cure=Cure("list the files under [files] in a recording sheet"),
                file=key,
            )
        parts[quantity] = table
    clocks = {quantity: _clock_column(table) for quantity, table in parts.items()}
    rows, notes = _common_rows(parts, clocks)
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


def _clock_column(table: LogTable) -> str | None:
    for name in table.columns:
        role = recognise(name)
        if role is not None and role.quantity == "time" and not role.joint:
            return name
    return None


def _common_rows(
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
