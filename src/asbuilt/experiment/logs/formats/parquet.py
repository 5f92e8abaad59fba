"""Recordings in Parquet files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import polars as pl

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.frames import numbers
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogStream,
    LogTable,
)
from asbuilt.findings import Cure


def scan_parquet(path: Path) -> tuple[pl.LazyFrame, tuple[str, ...], tuple[str, ...]]:
    """Open a Parquet file lazily, with the names of its numeric and of its other columns.

    Raises
    ------
    RecordingError
        If the file is no Parquet file or has no numeric column.
    """
    try:
        frame = pl.scan_parquet(path)
        schema = frame.collect_schema()
    except (pl.exceptions.PolarsError, OSError) as error:
        raise RecordingError(
            f"{path} is not a recording: it cannot be read as Parquet ({error})", file=str(path)
        ) from error
    numeric = tuple(
        name
        for name, kind in schema.items()
        if kind.is_numeric() or kind in (pl.Datetime, pl.Duration)
    )
    if not numeric:
        raise RecordingError(
            f"{path} is not a recording: none of its columns is numeric ({', '.join(schema)})",
            cure=Cure("write numbers, a column for each joint"),
            file=str(path),
        )
    return frame, numeric, tuple(name for name in schema if name not in numeric)


def read_parquet(path: Path) -> LogTable:
    """Read the numeric columns of a Parquet file; nulls become NaN and time stamps seconds.

    Raises
    ------
    RecordingError
        If the file is no Parquet file of numbers.
    """
    scanned, numeric, text = scan_parquet(path)
    frame = scanned.select(numeric).collect()
    columns = {name: numbers(frame[name]) for name in numeric}
    return LogTable(source=str(path), columns=columns, text_columns=text)


def _frames(
    path: Path, columns: Sequence[str], chunk_samples: int
) -> Iterator[tuple[int, pl.DataFrame]]:
    scanned = scan_parquet(path)[0]
    for begin in range(0, _n_rows(scanned), chunk_samples):
        yield begin, scanned.select(columns).slice(begin, chunk_samples).collect()


def _n_rows(scanned: pl.LazyFrame) -> int:
    return int(scanned.select(pl.len()).collect().item())


def _n_bytes(path: Path) -> float:
    scanned, names, _ = scan_parquet(path)
    return _n_rows(scanned) * len(names) * 8


FORMATS.register(
    "parquet",
    LogFormat(
        suffixes=(".parquet",),
        read=lambda path, sheet: read_parquet(path),
        stream=LogStream(
            columns=lambda path, sheet: scan_parquet(path)[1],
            frames=lambda path, sheet, columns, size: _frames(path, columns, size),
            n_bytes=_n_bytes,
        ),
    ),
)
