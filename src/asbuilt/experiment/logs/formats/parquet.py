"""Recordings in Parquet files, and columns of data frames of polars as floats."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import lazy_loader
import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogStream,
    LogTable,
    isolate,
    read_isolated,
)
from asbuilt.findings import Cure
from asbuilt.isolated_reading import Answer, FileKind, read_parts_apart
from asbuilt.untrusted import check_regular, describe_problem

if TYPE_CHECKING:
    import polars as pl
else:
    pl = lazy_loader.load("polars")

LARGEST = 1e12
"""Bytes of the largest Parquet file, which is read in chunks."""
FIRST_READ = 8_000_000
"""Memory [bytes] of what is read at first, when the beginning may be all that is asked for."""
MOST_READ = 128_000_000
"""Memory [bytes] that is read at once. A reading unpacks the pages of its row group before its
first row too: a long recording in one row group costs the square of its length over this."""
PARQUET = FileKind("Parquet")
LONG_PARQUET = replace(PARQUET, largest=LARGEST, in_parts=True)


def list_columns(frame: pl.DataFrame) -> dict[str, Array]:
    """Return all columns as floats."""
    return {name: convert_to_numbers(frame[name]) for name in frame.columns}


def convert_to_numbers(series: pl.Series) -> Array:
    """Return a column as floats; nulls become NaN and time stamps seconds."""
    if series.dtype in (pl.Datetime, pl.Duration):
        return convert_to_seconds(series)
    if series.dtype != pl.Float64:
        series = series.cast(pl.Float64)
    return (series.fill_null(float("nan")) if series.null_count() else series).to_numpy()


def convert_to_seconds(series: pl.Series) -> Array:
    """Turn time stamps or durations into seconds, time stamps since 1970."""
    kind = pl.Duration("ns") if series.dtype == pl.Duration else pl.Datetime("ns")
    return _count_seconds(series.cast(kind))


def _count_seconds(times: pl.Series) -> Array:
    """Return seconds (N,) of times that count nanoseconds, NaN where there are none."""
    counted = times.cast(pl.Int64).cast(pl.Float64).fill_null(float("nan"))
    return np.asarray(counted.to_numpy() / 1e9)


def parse_times(series: pl.Series) -> Array | None:
    """Turn cells of dates and times, or of times of day, into seconds; None if they are neither.

    Seconds since 1970 or since midnight; empty cells become NaN.

    >>> parse_times(pl.Series(["00:01:00.5", None])).tolist()
    [60.5, nan]
    """
    try:
        return convert_to_seconds(series.str.to_datetime(strict=True, time_unit="ns"))
    except pl.exceptions.PolarsError:
        pass
    try:
        of_day = series.str.to_time("%H:%M:%S%.f", strict=True)
    except pl.exceptions.PolarsError:
        return None
    return _count_seconds(of_day)


def scan_parquet(path: Path) -> tuple[pl.LazyFrame, LogTable]:
    """Open a Parquet file lazily, with the table of its numeric columns without their rows.

    Raises
    ------
    RecordingError
        If the file has no numeric column.
    """
    frame = pl.scan_parquet(path)
    schema = frame.collect_schema()
    also = (pl.Datetime, pl.Duration, pl.Boolean)
    numeric = [name for name, kind in schema.items() if kind.is_numeric() or kind in also]
    if not numeric:
        raise RecordingError(
            f"{path} is not a recording: none of its columns is numeric ({', '.join(schema)})",
            cure=Cure("write numbers, a column for each joint"),
            file=str(path),
        )
    columns = {name: np.empty(0) for name in numeric}
    text = tuple(name for name in schema if name not in columns)
    return frame, LogTable(str(path), columns, text_columns=text, order=tuple(schema))


def read_parquet(path: Path) -> LogTable:
    """Read the numeric columns of a Parquet file; nulls become NaN and time stamps seconds."""
    frame, header = scan_parquet(path)
    return replace(header, columns=list_columns(frame.select([*header.columns]).collect()))


def _read_chunks(
    path: Path, columns: Sequence[str], chunk_samples: int
) -> Iterator[tuple[int, dict[str, Array]]]:
    """Read chunks in another process, and check before what they may be."""
    rows, header = _read_declared(path)
    missing = [name for name in columns if name not in header.columns]
    if missing:
        raise RecordingError(f"{path} has no column {missing[0]!r}", file=str(path))
    parts = read_parts_apart(
        read_row_ranges,
        path,
        LONG_PARQUET,
        columns=[*columns],
        rows=rows,
        chunk_samples=chunk_samples,
    )
    for document, values in parts:
        yield document["first"], dict(zip(columns, values, strict=True))


def read_row_ranges(
    path: Path, columns: Sequence[str], rows: int, chunk_samples: int
) -> Iterator[Answer]:
    """Yield the columns of so many rows at a time, in the process that reads the file."""
    row_bytes = 8 * max(len(columns), 1)
    at_once = max(chunk_samples, FIRST_READ // (row_bytes * chunk_samples) * chunk_samples)
    most = max(chunk_samples, MOST_READ // (row_bytes * chunk_samples) * chunk_samples)
    begin = 0
    while begin < rows:
        try:
            lazy = scan_parquet(path)[0]
            # One by one: a reading holds all pages of its row group, at worst those of the file.
            parts = [lazy.select(name).slice(begin, at_once).collect() for name in columns]
            frame = pl.concat(parts, how="horizontal")
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
            raise RecordingError(
                f"{path}: rows {begin + 1} to {min(begin + at_once, rows)} cannot be"
                f" read ({describe_problem(error)})",
                cure=Cure("record or export it again"),
                file=str(path),
            ) from None
        for first in range(0, frame.height, chunk_samples):
            chunk = list_columns(frame.slice(first, chunk_samples))
            yield {"first": begin + first}, [chunk[name] for name in columns]
        # Else both are held while the next are read.
        del frame, parts
        begin += at_once
        at_once = min(2 * at_once, most)


def read_parquet_header(path: Path) -> LogTable:
    """Return the columns of a Parquet file, empty, with the number of rows as a note.

    Raises
    ------
    RecordingError
        If the file declares more than its size can hold.
    """
    frame, header = scan_parquet(path)
    rows = int(frame.select(pl.len()).collect().item())
    count = len(header.columns)
    if rows * count * 8 > 1e9 + 1000 * path.stat().st_size:
        raise RecordingError(
            f"{path} declares {rows:.3g} rows of {count} columns, too many for a file of its size",
            file=str(path),
        )
    return replace(header, notes=(str(rows),))


def _read_declared(path: Path) -> tuple[int, LogTable]:
    """Return the number of rows and the table without them, read once for each state of a file."""
    check_regular(path, "recording", RecordingError, LARGEST)
    state = path.stat()
    return _read_declared_once(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=64)
def _read_declared_once(path: Path, size: int, changed: int) -> tuple[int, LogTable]:
    header = read_isolated(read_parquet_header, path, LONG_PARQUET)
    return int(header.notes[0]), replace(header, notes=())


def _estimate_memory(path: Path) -> float:
    """Return the memory of a whole file; a small file need not be opened for it."""
    # Bytes below which a file is read whole, whatever it declares; its reader limits the memory.
    if path.stat().st_size < 20e6:
        return float(path.stat().st_size)
    rows, header = _read_declared(path)
    return float(rows * len(header.columns) * 8)


FORMATS.register(
    "parquet",
    LogFormat(
        suffixes=(".parquet",),
        read=isolate(read_parquet, PARQUET),
        stream=lambda path, sheet: LogStream(_read_declared(path)[1], partial(_read_chunks, path)),
        n_bytes=_estimate_memory,
    ),
)
