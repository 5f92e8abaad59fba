"""Columns of data frames of polars as floats."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader
import numpy as np

from asbuilt.arrays import Array

if TYPE_CHECKING:
    import polars as pl
else:
    pl = lazy_loader.load("polars")


def columns_of(frame: pl.DataFrame) -> dict[str, Array]:
    """Return all columns as floats."""
    return {name: numbers(frame[name]) for name in frame.columns}


def numbers(series: pl.Series) -> Array:
    """Return a column as floats; nulls become NaN and time stamps seconds."""
    if series.dtype in (pl.Datetime, pl.Duration):
        return seconds(series)
    if series.dtype != pl.Float64:
        series = series.cast(pl.Float64)
    return (series.fill_null(float("nan")) if series.null_count() else series).to_numpy()


def seconds(series: pl.Series) -> Array:
    """Turn time stamps or durations into seconds, time stamps since 1970."""
    kind = pl.Duration("ns") if series.dtype == pl.Duration else pl.Datetime("ns")
    return _from_nanoseconds(series.cast(kind))


def _from_nanoseconds(times: pl.Series) -> Array:
    """Return seconds (N,) of times that count nanoseconds, NaN where there are none."""
    counted = times.cast(pl.Int64).cast(pl.Float64).fill_null(float("nan"))
    return np.asarray(counted.to_numpy() / 1e9)


def seconds_of_text(series: pl.Series) -> Array | None:
    """Turn cells of dates and times, or of times of day, into seconds; None if they are neither.

    Seconds since 1970 or since midnight; empty cells become NaN.

    >>> seconds_of_text(pl.Series(["00:01:00.5", None])).tolist()
    [60.5, nan]
    """
    try:
        return seconds(series.str.to_datetime(strict=True, time_unit="ns"))
    except pl.exceptions.PolarsError:
        pass
    try:
        of_day = series.str.to_time("%H:%M:%S%.f", strict=True)
    except pl.exceptions.PolarsError:
        return None
    return _from_nanoseconds(of_day)
