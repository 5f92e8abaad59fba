"""Read a recording longer than memory, a stretch at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import polars as pl

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.delimited import (
    bad_cell,
    find_dialect,
    scan_delimited,
    without_blank_lines,
)
from asbuilt.experiment.logs.formats.parquet import scan_parquet, seconds
from asbuilt.experiment.logs.formats.table import Table
from asbuilt.experiment.logs.layout import find_layout
from asbuilt.experiment.logs.readers import (
    TEXT_SUFFIXES,
    PathLike,
    ReadingOptions,
    apply_sheet,
    build_recording,
    check_readable,
    clock_origin,
    find_sheet,
    read_recording,
)
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import Recording


def stream_recording(
    path: PathLike, *, chunk_samples: int = 200_000, **options: Unpack[ReadingOptions]
) -> Iterator[Recording]:
    """Read a recording in consecutive stretches of `chunk_samples`, the last of which may be
    shorter.

    Parquet is read in slices and delimited text lazily, so memory depends on the stretch, not on
    the length; other formats are read whole first. Extra quantities are left out. Options are those
    of `read_recording`.

    Raises
    ------
    RecordingError
        As `read_recording`; a bad cell is reported when its stretch is reached.
    """
    if chunk_samples < 1:
        raise RecordingError(f"chunk_samples must be at least 1, got {chunk_samples}")
    path = Path(path)
    check_readable(path)
    described, notes = find_sheet(path, options.get("sheet"))
    suffix = path.suffix.lower()
    blank = described.separator == " " or (
        suffix in TEXT_SUFFIXES and find_dialect(path).separator == ""
    )
    if (
        described.files.position is not None
        or blank
        or (suffix != ".parquet" and suffix not in TEXT_SUFFIXES)
    ):
        whole = read_recording(path, **(options | {"sheet": described}))
        yield from (
            whole.taken(slice(begin, begin + chunk_samples))
            for begin in range(0, whole.n_samples, chunk_samples)
        )
        return
    source = str(path)
    layout = find_layout(
        source, _column_names(path, described), model=options.get("model"), sheet=described
    )
    layout = replace(
        layout,
        quantities={
            k: v
            for k, v in layout.quantities.items()
            if k in {"position", "velocity", "acceleration", "torque"}
        },
    )
    rate = options.get("rate")
    if rate is None:
        rate = described.rate
    windowless = described.model_copy(update={"windows": []})
    origin: float | None = None
    start = 0.0
    for first, frame in _frames(path, described, layout.columns, chunk_samples):
        table = Table(
            source=source, columns={name: _numbers(frame[name]) for name in layout.columns}
        )
        if origin is None and layout.time is not None:
            t = table.columns[layout.time] * layout.scales[layout.time]
            origin = clock_origin(t)
            start = float(t[0]) - origin
        chunk = build_recording(table, layout, rate=rate, first_sample=first, origin=origin)
        chunk = apply_sheet(
            replace(chunk, notes=(*notes, *chunk.notes)),
            windowless,
            flip_torque=options.get("flip_torque", False),
            gain=options.get("gain"),
            torque_source=options.get("torque_source"),
        )
        if described.windows:
            inside = described.in_windows(chunk.t, start)
            if not inside.any():
                continue
            chunk = chunk.taken(inside)
        yield chunk


def _column_names(path: Path, sheet: RecordingSheet) -> tuple[str, ...]:
    if path.suffix.lower() == ".parquet":
        return scan_parquet(path)[1]
    dialect = find_dialect(path, header=sheet.header, separator=sheet.separator)
    if dialect.headless and sheet.columns.position is None:
        raise RecordingError(
            f"{path} has {len(dialect.names)} columns without names; say what they are in a"
            " recording sheet: [columns] position = ..."
        )
    return tuple(name for name in dialect.names if name not in dialect.text_columns)


def _frames(
    path: Path, sheet: RecordingSheet, columns: list[str], chunk_samples: int
) -> Iterator[tuple[int, pl.DataFrame]]:
    """Yield the index of the first row, and the frame of the needed columns."""
    if path.suffix.lower() == ".parquet":
        scanned = scan_parquet(path)[0]
        total = int(scanned.select(pl.len()).collect().item())
        for begin in range(0, total, chunk_samples):
            yield begin, scanned.select(columns).slice(begin, chunk_samples).collect()
        return
    dialect = find_dialect(path, header=sheet.header, separator=sheet.separator)
    done = 0
    try:
        for frame in without_blank_lines(
            scan_delimited(path, dialect).select(columns)
        ).collect_batches(chunk_size=chunk_samples, maintain_order=True):
            yield done, frame
            done += frame.height
    except pl.exceptions.PolarsError as error:
        raise RecordingError(bad_cell(path, dialect, error)) from error


def _numbers(series: pl.Series) -> Array:
    if series.dtype in (pl.Datetime, pl.Duration):
        return seconds(series)
    if series.dtype != pl.Float64:
        series = series.cast(pl.Float64)
    return (series.fill_null(float("nan")) if series.null_count() else series).to_numpy()
