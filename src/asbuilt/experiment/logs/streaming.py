"""Reading of a recording in chunks, for logs that exceed the memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.assembly import apply_sheet, build_recording, logged_times
from asbuilt.experiment.logs.formats.frames import numbers
from asbuilt.experiment.logs.formats.log_format import LogStream, LogTable, log_format
from asbuilt.experiment.logs.options import PathLike, ReadingOptions, reading_options
from asbuilt.experiment.logs.readers import (
    check_readable,
    find_sheet,
    layout_of,
    read_recording,
)
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import Recording

_STREAMED = ("position", "velocity", "acceleration", "torque", "command")


def stream_recording(
    path: PathLike,
    *,
    model: RobotModel | None = None,
    options: ReadingOptions | None = None,
    chunk_samples: int = 200_000,
    **settings: Any,
) -> Iterator[Recording]:
    """Read a recording in consecutive chunks.

    Parquet and delimited text are read lazily, so memory depends on the chunk, not on the length;
    other formats are read whole first. Extra quantities are left out.

    Parameters
    ----------
    path
        The log.
    chunk_samples
        Samples per chunk; the last chunk may be shorter.
    model, options, **settings
        As of `read_recording`.

    Raises
    ------
    RecordingError
        As `read_recording`; a bad cell is reported when its chunk is reached.
    """
    if chunk_samples < 1:
        raise RecordingError(
            f"chunk_samples must be at least 1, got {chunk_samples}", value=chunk_samples, lower=1
        )
    path, chosen = Path(path), reading_options(options, settings)
    check_readable(path)
    sheet, notes = find_sheet(path, chosen.sheet)
    whole_first = sheet.files.position is not None or sheet.sign == "command"
    stream = None if whole_first or path.suffix == ".toml" else log_format(path).stream
    header = None if stream is None else stream.header(path, sheet)
    if stream is None or header is None:
        whole = read_recording(path, model=model, options=replace(chosen, sheet=sheet))
        for begin in range(0, whole.n_samples, chunk_samples):
            yield whole.taken(slice(begin, begin + chunk_samples))
        return
    try:
        layout = layout_of(header, sheet, model, chosen)
    except RecordingError:
        layout = layout_of(_first_rows(stream, header, path, sheet), sheet, model, chosen)
    quantities = {name: layout.quantities[name] for name in _STREAMED if name in layout.quantities}
    layout = replace(layout, quantities=quantities)
    rate = chosen.rate if chosen.rate is not None else sheet.rate
    windowless = sheet.model_copy(update={"windows": []})
    origin: float | None = None
    start = 0.0
    for first, frame in stream.frames(path, sheet, layout.columns, chunk_samples):
        columns = {name: numbers(frame[name]) for name in layout.columns}
        table = replace(header, columns=columns)
        if origin is None and layout.time is not None:
            t, origin = logged_times(table, layout)
            start = float(t[0])
        chunk = build_recording(table, layout, rate=rate, first_sample=first, origin=origin)
        chunk = apply_sheet(replace(chunk, notes=(*notes, *chunk.notes)), windowless, chosen)
        if sheet.windows:
            inside = sheet.in_windows(chunk.t, start)
            if not inside.any():
                continue
            chunk = chunk.taken(inside)
        yield chunk


def _first_rows(stream: LogStream, header: LogTable, path: Path, sheet: RecordingSheet) -> LogTable:
    """Return the first rows of all numeric columns, by which an error drafts a sheet."""
    # Samples by which the draft of a sheet is made.
    for _, frame in stream.frames(path, sheet, tuple(header.columns), 2000):
        return replace(header, columns={name: numbers(frame[name]) for name in header.columns})
    return header
