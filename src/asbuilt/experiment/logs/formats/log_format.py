"""Log formats: the table of a file or of data in memory, the registry, and reading with limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.findings import Cure
from asbuilt.isolated_reading import ANY_FILE, Answer, FileKind, read_apart
from asbuilt.registry import Registry

if TYPE_CHECKING:
    from asbuilt.experiment.logs.sheet import RecordingSheet


REPACKED: Mapping[str, str] = {
    **dict.fromkeys((".gz", ".zip", ".bz2", ".xz", ".zst", ".7z"), "unpack it first"),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "export the sheet as CSV"),
}
"""What to do first with files of other formats."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """Hold the named columns of a log, all of length N.

    Parameters
    ----------
    source
        Name of the file.
    columns
        Numeric columns, each (N,).
    named
        Whether the file has column names; without a header row the columns are "1", "2", ...
    text_columns
        Names of the columns that do not hold numbers.
    known
        Quantity and joint of columns whose format gives them, such as a ROS message; both "" of
        columns of a floating base, which are no joint's. Quantities are "time" and those of
        `QUANTITIES` in `columns/layout.py`: "position", "velocity", "acceleration", "torque",
        "command"; others are kept as extras.
    notes
        What was assumed or left out, in sentences.
    order
        Names of all columns in the order of the file, text columns too, by which a sheet numbers
        them; by default the numeric ones.
    open_units
        Columns of positions and commands of an unknown unit, which the sheet has to give.
    ranges
        Two numbers of a column and the positions [rad or m] there, from a calibration.
    frames
        Frames of the "base", of its sensor ("imu") and of the "world", as far as a format says.
    unread
        Why the "base", "imu" or a contact of a floating base has no columns, and what to do.
    """

    source: str
    columns: Mapping[str, Array]
    named: bool = True
    text_columns: tuple[str, ...] = ()
    known: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    order: tuple[str, ...] = ()
    open_units: tuple[str, ...] = ()
    ranges: Mapping[str, Sequence[float]] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    unread: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        """Number of rows."""
        return next(iter(self.columns.values())).size if self.columns else 0


@dataclass(frozen=True, slots=True)
class LogStream:
    """Hold a file that is read in chunks.

    Parameters
    ----------
    header
        The table of the file without its rows.
    chunks
        Yield the index of the first row and the given columns, for each chunk of so many rows.
    """

    header: LogTable
    chunks: Callable[[Sequence[str], int], Iterator[tuple[int, dict[str, Array]]]]

    def read_first(self, n_samples: int) -> LogTable:
        """Return the table with its first rows, at most so many."""
        for _, columns in self.chunks(tuple(self.header.columns), n_samples):
            return replace(self.header, columns=columns)
        return self.header


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFormat:
    """Describe a log format.

    Parameters
    ----------
    suffixes
        Suffixes of its files, such as `(".csv",)`.
    read
        Function that reads a file, given its recording sheet.
    stream
        Function that opens a file, given its sheet, to be read in chunks; None is returned for one
        that must be read whole, as all are by default.
    n_bytes
        Return about how much memory a file takes; None for formats whose files are read whole.
    folders
        Whether a folder may be a log of this format.
    recognises
        Whether this folder is one, where several formats have folders; None for the rest.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path, RecordingSheet], LogTable]
    stream: Callable[[Path, RecordingSheet], LogStream | None] = lambda path, sheet: None
    n_bytes: Callable[[Path], float] | None = None
    folders: bool = False
    recognises: Callable[[Path], bool] | None = None


FORMATS: Registry[LogFormat] = Registry(
    "log format", "asbuilt.experiment.logs.formats", "asbuilt.log_formats"
)


def choose_log_format(path: Path) -> LogFormat:
    """Return the format of a file or folder by its suffix.

    Raises
    ------
    RecordingError
        If no format has this suffix, or the path is not a regular file, or it is empty.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        found = _find_folder_format(path)
    else:
        found = next((each for each in FORMATS.values() if suffix in each.suffixes), None)
    if not path.is_dir() and not path.is_file():
        raise RecordingError(
            f"{path} is not a recording: it is not a regular file",
            cure=Cure("save what it yields as a file"),
            file=str(path),
        )
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path} is not a recording: it is empty", file=str(path))
    if found is None:
        known = sorted(suffix for each in FORMATS.values() for suffix in each.suffixes)
        raise RecordingError(
            f"{path} is not a recording that can be read: known are {', '.join(known)} and"
            " folders of ROS 2 bags, SAGE motions and LeRobot datasets",
            cure=Cure(REPACKED[suffix]) if suffix in REPACKED else None,
            file=str(path),
            available=known,
        )
    return found


def _find_folder_format(path: Path) -> LogFormat | None:
    """Return the format that recognises a folder, else the one that takes any."""
    of_folders = [each for each in FORMATS.values() if each.folders]
    certain = (folder for folder in of_folders if folder.recognises and folder.recognises(path))
    return next(certain, next((folder for folder in of_folders if folder.recognises is None), None))


def tabulate_joints(
    source: str,
    t: Array,
    groups: Iterable[tuple[str, str, Sequence[str], Array]],
    notes: Sequence[str] = (),
) -> LogTable:
    """Return a table of times [s] and of matrices (N, n) with the names of their joints.

    A group has a label, by which its columns are `joint/label`, a quantity, joints and values.
    """
    columns = {"time": t}
    known = dict[str, tuple[str, str]]()
    for label, quantity, joints, values in groups:
        for joint, column in zip(joints, values.T, strict=True):
            columns[f"{joint}/{label}"] = np.ascontiguousarray(column)
            known[f"{joint}/{label}"] = (quantity, joint)
    return LogTable(source=source, columns=columns, known=known, notes=tuple(notes))


def hold_last(times: NDArray[Any], sent: NDArray[Any], values: Array) -> tuple[Array, list[str]]:
    """Return the commands (N, n) that held at times, each since it was sent, and notes."""
    last = np.searchsorted(sent, times, side="right") - 1
    before = int(np.count_nonzero(last < 0))
    note = f"{before} states before the first command count as commanded like it"
    return values[np.maximum(last, 0)], [note] if before else []


def measure_gaps(at: NDArray[Any], t: NDArray[Any]) -> NDArray[Any]:
    """Return how far the samples at rising times t (M,) are apart around other times, shape (N,).

    >>> measure_gaps(np.array([0.5, 2.0, 9.0]), np.array([0.0, 1.0, 4.0])).tolist()
    [1.0, 3.0, 3.0]
    """
    after = np.clip(np.searchsorted(t, at), 1, t.size - 1)
    return np.asarray(t[after] - t[after - 1])


def tabulate_variables(source: str, variables: Mapping[str, Array]) -> LogTable:
    """Spread vectors (N,) and matrices (N, m) or (m, N) over columns.

    A matrix `positions` gives `positions_1`, ..., `positions_m`. N is the length that most
    variables share; variables without it, and complex ones, are left out.

    Raises
    ------
    RecordingError
        If no variable is a numeric vector or matrix.
    """
    arrays = {name: np.squeeze(_count_seconds(value)) for name, value in variables.items()}
    arrays = {
        name: a
        for name, a in arrays.items()
        if a.ndim in (1, 2) and a.size > 1 and a.dtype.kind in "biufc"
    }
    if not any(np.isrealobj(a) for a in arrays.values()):
        raise RecordingError(
            f"{source} is not a recording: it holds no numeric vector or matrix (found"
            f" {', '.join(variables) or 'nothing'})",
            file=source,
        )
    votes = Counter(size for array in arrays.values() for size in {*array.shape})
    length = max(votes, key=lambda size: (votes[size], size))
    columns: dict[str, Array] = {}
    left_out = []
    for name, array in arrays.items():
        if length not in array.shape or np.iscomplexobj(array):
            complex_ = " (complex)" if np.iscomplexobj(array) else ""
            left_out.append(f"{name} {array.shape}{complex_}")
            continue
        rows = np.atleast_2d(array.T if array.shape[0] == length else array).astype(np.float64)
        names = [name] if array.ndim == 1 else [f"{name}_{k + 1}" for k in range(len(rows))]
        columns |= zip(names, map(np.ascontiguousarray, rows), strict=True)
    listed = ", ".join(left_out)
    notes = (f"variables without the common length {length} were left out: {listed}",)
    return LogTable(source=source, columns=columns, notes=notes if left_out else ())


def is_columns(item: Any) -> bool:
    """Return whether an object is a dict of arrays or a data frame of pandas or polars."""
    return isinstance(item, Mapping) or (hasattr(item, "columns") and hasattr(item, "__getitem__"))


def tabulate_columns(item: Any) -> LogTable:
    """Return the columns of a dict of arrays (vectors or matrices) or of a data frame.

    A named index of a pandas frame counts as a column; time stamps become seconds, NaN where one
    is missing.

    Raises
    ------
    RecordingError
        If no column is numeric.
    """
    if isinstance(item, Mapping):
        return tabulate_variables("dict of arrays", {str(name): item[name] for name in item})
    frame = item
    if getattr(getattr(item, "index", None), "name", None) is not None:
        frame = item.reset_index()
    found = {str(name): _count_seconds(frame[name].to_numpy()) for name in frame.columns}
    columns = {
        name: values.astype(np.float64)
        for name, values in found.items()
        if values.dtype.kind in "biuf"
    }
    if not columns:
        raise RecordingError(
            "the data frame is not a recording: none of its columns is numeric"
            f" ({', '.join(found)})"
        )
    text = tuple(name for name in found if name not in columns)
    return LogTable(source="data frame", columns=columns, text_columns=text, order=tuple(found))


def _count_seconds(values: Any) -> NDArray[Any]:
    """Return an array, whose time stamps or durations are counted in seconds."""
    array = np.asarray(values)
    if array.dtype.kind not in "mM":
        return array
    counted = array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64) / 1e9
    return np.where(np.isnat(array), np.nan, counted)


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
