"""What an entry of a ledger may hold: its columns, their types, and the range of each number.

docs/reference/fleet-ledger.md describes the columns. A number outside its range is of no log, and
its squares would overflow wherever an entry is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Literal, get_args

import polars as pl

from asbuilt.ranges import Range

EARLIEST = datetime(2000, 1, 1, tzinfo=UTC)
LATEST = datetime(2100, 1, 1, tzinfo=UTC)
"""Dates that a clock can be trusted for; a counter since power-on is none."""
DateSource = Literal["given", "sheet", "stamps", "name"]
SCHEMA: dict[str, Any] = {
    "robot_id": pl.String,
    "robot_type": pl.String,
    "settings": pl.String,
    "log": pl.String,
    "source_sha256": pl.String,
    "date": pl.Datetime("us", "UTC"),
    "date_from": pl.String,
    "duration": pl.Float64,
    "rate": pl.Float64,
    "block": pl.Int16,
    "start": pl.Float64,
    "stop": pl.Float64,
    "n_samples": pl.Int64,
    "joint": pl.String,
    "torque_sum": pl.Float64,
    "columns": pl.List(pl.Int16),
    "factor": pl.List(pl.Float64),
    "tilt": pl.List(pl.Float64),
    "covariates": pl.List(pl.Struct({"name": pl.String, "value": pl.Float64})),
    "warnings": pl.List(pl.String),
    "software": pl.String,
    "format_version": pl.Int16,
}
SUMS = Range(-1e18, 1e18)
"""Sums over samples: 1e12 of them, of 1 MN m each; fourth powers do not overflow."""
LEAST = 1e-9
"""Largest number of a factor [N m] below which its log says nothing: drives resolve 1e-4 N m."""
RANGES: Mapping[str, Range] = {
    "duration": Range(0.0, 1e9, "s", above=True),  # thirty years
    "rate": Range(1e-3, 1e6, "Hz"),
    "start": Range(-1e10, 1e10, "s"),
    "stop": Range(-1e10, 1e10, "s"),
    "n_samples": Range(1, 1e12),
    "torque_sum": SUMS,
    "factor": SUMS,
    "tilt": SUMS,
    "covariates": Range(-1e6, 1e6),
}
OPTIONAL = ("tilt", "covariates")
"""Columns that may lack values; earlier entries have no `tilt` at all."""
LONGEST_TEXT = 1000
"""Letters of a text, such as the name of a log with its folders."""


def check_schema(frame: pl.DataFrame) -> None:
    """Raise `ValueError` with column and value unless a table is one of an entry."""
    for name, kind in SCHEMA.items():
        if name == "tilt" and name not in frame.columns:
            continue
        column = frame[name]
        if column.dtype != kind:
            raise ValueError(f"{name} is of type {column.dtype}, not {kind}")
        if name not in OPTIONAL and column.has_nulls():
            raise ValueError(f"{name} has no value in some rows")
        values = column.explode() if isinstance(kind, pl.List) else column
        if values.dtype == pl.Struct:
            _check_texts(name, values.struct.field("name"))
            values = values.struct.field("value")
        if name in RANGES:
            _check_numbers(name, values.drop_nulls())
        elif values.dtype == pl.String:
            _check_texts(name, values)
    if not (frame["factor"].explode().abs() >= LEAST).any():
        raise ValueError("factor holds no information: all of its numbers are zero")
    _check_dates(frame["date"])
    if not frame["date_from"].is_in(get_args(DateSource)).all():
        raise ValueError(f"date_from is {frame['date_from'][0]!r}, not {get_args(DateSource)}")
    if (frame["start"] > frame["stop"]).any():
        raise ValueError("start lies behind stop in some rows")


def _check_numbers(name: str, values: pl.Series) -> None:
    allowed = RANGES[name]
    outside = ~values.is_between(allowed.lower, allowed.upper)  # NaN is in no range
    if allowed.above:
        outside |= values == allowed.lower
    if outside.any():
        worst = values.filter(outside)[0]
        raise ValueError(f"{name} holds {worst:g}; it must be a number {allowed}")


def _check_texts(name: str, texts: pl.Series) -> None:
    lengths = texts.drop_nulls().str.len_chars().to_list()
    if lengths and max(lengths) > LONGEST_TEXT:
        raise ValueError(f"{name} has {max(lengths)} letters; at most {LONGEST_TEXT} are read")


def _check_dates(dates: pl.Series) -> None:
    """Compare as numbers, since Python has no dates beyond the year 9999."""
    first, last = (int(each.timestamp() * 1e6) for each in (EARLIEST, LATEST))
    stamps = dates.cast(pl.Int64)
    if not stamps.is_between(first, last, closed="left").all():
        raise ValueError(f"date is not between {EARLIEST:%Y} and {LATEST:%Y}")
