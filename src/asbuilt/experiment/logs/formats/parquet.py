"""Recordings in Parquet files."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.table import Table


def scan_parquet(path: Path) -> tuple[pl.LazyFrame, tuple[str, ...], tuple[str, ...]]:
    """Open a Parquet file lazily.

    Return it with the names of its numeric columns and of the others.

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
            f"{path} is not a recording: it cannot be read as Parquet ({error})"
        ) from error
    numeric = tuple(
        name
        for name, kind in schema.items()
        if kind.is_numeric() or kind in (pl.Datetime, pl.Duration)
    )
    if not numeric:
        raise RecordingError(
            f"{path} is not a recording: none of its columns is numeric ({', '.join(schema)});"
            " write numbers, a column for each joint"
        )
    return frame, numeric, tuple(name for name in schema if name not in numeric)


def read_parquet(path: Path) -> Table:
    """Read the numeric columns of a Parquet file; nulls become NaN and time stamps seconds.

    Raises
    ------
    RecordingError
        If the file is no Parquet file of numbers.
    """
    scanned, numeric, text = scan_parquet(path)
    frame = scanned.select(numeric).collect()
    columns = {}
    for name in numeric:
        series = frame[name]
        if series.dtype in (pl.Datetime, pl.Duration):
            columns[name] = seconds(series)
            continue
        columns[name] = series.cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return Table(source=str(path), columns=columns, text_columns=text)


def seconds(series: pl.Series) -> Array:
    """Turn time stamps or durations into seconds, time stamps since 1970."""
    kind = pl.Duration("ns") if series.dtype == pl.Duration else pl.Datetime("ns")
    return (
        (series.cast(kind).cast(pl.Int64).cast(pl.Float64) * 1e-9)
        .fill_null(float("nan"))
        .to_numpy()
    )
