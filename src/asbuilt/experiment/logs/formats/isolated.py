"""Logs of unknown origin, read in another process with limits of what they may cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.isolated_reading import ANY_FILE, Answer, FileKind, read_apart

if TYPE_CHECKING:
    from asbuilt.experiment.logs.sheet import RecordingSheet

MOST_COLUMNS = 10_000
"""Columns of a log; 30 joints with 10 quantities have 300."""


def isolate(
    read: Callable[..., LogTable], kind: FileKind, *, by_sheet: bool = False
) -> Callable[[Path, RecordingSheet], LogTable]:
    """Return the reader of a format that calls `read` in another process (`read_isolated`).

    It gets the path of a file, and the recording sheet too if the format is read `by_sheet`.
    """
    return lambda path, sheet: read_isolated(
        read, path, kind, **({"sheet": sheet} if by_sheet else {})
    )


def read_isolated(
    read: Callable[..., LogTable], path: Path, kind: FileKind = ANY_FILE, **settings: Any
) -> LogTable:
    """Return the log that `read(path, **settings)` returns, called in a process of its own.

    Parameters and errors are those of `read_apart`.
    """
    answer, columns = read_apart(answer_with_table, path, kind, reader=read, **settings)
    known = {name: tuple(each) for name, each in answer.pop("known").items()}
    lists = {name: tuple(each) for name, each in answer.items() if isinstance(each, list)}
    named = dict(zip(lists.pop("columns"), columns, strict=True))
    return LogTable(**{**answer, **lists, "columns": named, "known": known})


def answer_with_table(path: Path, reader: Callable[..., LogTable], **settings: Any) -> Answer:
    """Return the log of a file as plain data and its columns, in the process that reads it."""
    table = reader(path, **settings)
    if len(table.columns) > MOST_COLUMNS:
        raise RecordingError(
            f"{path} has {len(table.columns)} columns; at most {MOST_COLUMNS} are read"
        )
    document = {entry.name: getattr(table, entry.name) for entry in dataclass_fields(table)}
    return document | {"columns": list(table.columns)}, [*table.columns.values()]
