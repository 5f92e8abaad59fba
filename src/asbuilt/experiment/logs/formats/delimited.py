"""Recordings as delimited text: CSV and its relatives."""

from __future__ import annotations

import itertools
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import lazy_loader
import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    MOST_COLUMNS,
    LogFormat,
    LogStream,
    LogTable,
)
from asbuilt.experiment.logs.formats.parquet import list_columns, parse_times
from asbuilt.experiment.logs.formats.ros.joint_table import is_topic_echo, read_topic_echo
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.findings import Cure

if TYPE_CHECKING:
    import polars as pl
else:
    pl = lazy_loader.load("polars")

_COMMENTS = ("#", "%")
_PACKED = {
    b"\xff\xfe": ("UTF-16 text", "save it as UTF-8"),
    b"\xfe\xff": ("UTF-16 text", "save it as UTF-8"),
    b"\x1f\x8b": ("a gzip archive", "unpack it"),
    b"PK\x03\x04": ("a ZIP archive or a spreadsheet", "unpack it, or export the sheet as CSV"),
}
"""First bytes of files that are not text, whatever their suffix."""
FIRST_LINES = 64
"""Lines by which names, separator and decimal comma are told."""
LONGEST_LINE = 1_000_000
"""Characters of a line; 10 000 columns of full precision have fewer."""
AT_ONCE = 1 << 20
"""Bytes that are searched at once."""
SMALL = 6 << 20
"""Bytes of a table of nothing but numbers that numpy reads before polars would be imported."""
_MISSING = ["", "NA", "N/A", "null", "None", "-"]


@dataclass(frozen=True)
class Dialect:
    """Describe a text file; `separator` is "" for blanks, `skip` lines precede the data.

    Text columns of dates and times are `dated`. `rows` counts the rows before a last line
    that is cut, as where a recorder was stopped while it wrote; None if it is whole.
    """

    separator: str
    decimal_comma: bool
    skip: int
    names: tuple[str, ...]
    named: bool
    text_columns: tuple[str, ...]
    dated: tuple[str, ...] = ()
    rows: int | None = None

    @property
    def numeric(self) -> tuple[str, ...]:
        """Columns that become numbers, in the order of the file."""
        text = set(self.text_columns) - set(self.dated)
        return tuple(name for name in self.names if name not in text)


def find_dialect(
    path: Path,
    *,
    header: bool | None = None,
    separator: str | None = None,
    numbered: bool = False,
) -> Dialect:
    """Find separator, header row and column names from the first lines.

    If `header` is None, a first line is the header row unless its cells are numbers, or text,
    where the cells of the second line are. If the columns are `numbered` a name may be repeated.

    Raises
    ------
    RecordingError
        If the file is empty, not text, holds no numbers, or names a column twice.
    """
    lines = _read_first_lines(path)
    body = [
        k
        for k, line in enumerate(lines)
        if line.strip() and not line.lstrip().startswith(_COMMENTS)
    ]
    if not body:
        raise RecordingError(f"{path} is not a recording: it is empty", file=str(path))
    if separator is None:
        separator = _find_separator([lines[k] for k in body[:20]])
    names, *rest = (_split_fields(lines[k], separator) for k in body[:3])
    decimal_comma = separator not in ("", ",") and any("," in cell for row in rest for cell in row)
    is_number = partial(_is_number, decimal_comma=decimal_comma)
    skip = body[0]
    data = names
    named = _is_header(names, rest, is_number) if header is None else header
    if named and not rest:
        raise RecordingError(
            f"{path} is not a recording: it has a header ({', '.join(names[:6])}) but no data",
            file=str(path),
        )
    if named:
        skip = body[1]
        data = rest[0]
        words = [not any(map(is_number, row)) for row in rest]
        if words == [True, False] and len(data) == len(names):
            pairs = zip(names, data, strict=True)
            names = [f"{name} [{unit}]" if unit else name for name, unit in pairs]
            skip = body[2]
            data = rest[1]
    else:
        commented = _split_fields(lines[skip - 1].lstrip(" #%"), separator) if skip > 0 else []
        named = (
            header is None and len(commented) == len(data) and not any(map(is_number, commented))
        )
        names = commented if named else [str(k) for k in range(1, len(data) + 1)]
    names = [name or f"unnamed {k}" for k, name in enumerate(names, start=1)]
    counts = Counter(names)
    repeated = next((name for name in names if counts[name] > 1), None)
    if len(names) > MOST_COLUMNS:
        raise RecordingError(
            f"{path} has {len(names)} columns; at most {MOST_COLUMNS} are read",
            file=str(path),
            value=len(names),
            upper=MOST_COLUMNS,
        )
    if repeated is not None and not numbered:
        places = [str(k) for k, name in enumerate(names, 1) if name == repeated]
        raise RecordingError(
            f"{path}: the column name {repeated!r} appears {len(places)} times (columns"
            f" {', '.join(places)})",
            cure=Cure("rename one of them, or number all columns in a recording sheet"),
            file=str(path),
            value=repeated,
        )
    names = [f"{name} ({k})" if counts[name] > 1 else name for k, name in enumerate(names, 1)]
    text = tuple(
        name
        for name, cell in itertools.zip_longest(names, data, fillvalue="")
        if name and not is_number(cell) and cell not in _MISSING
    )
    dated = tuple(
        name
        for name, cell in zip(names, data, strict=False)
        if name in text and parse_times(pl.Series([cell])) is not None
    )
    if len(text) == len(names):
        raise RecordingError(
            f"{path} is not a recording: line {skip + 1} holds no number"
            f" ({lines[skip].strip()[:60]!r})",
            cure=Cure("remove the lines above the header"),
            file=str(path),
            line=skip + 1,
        )
    rows = _count_rows_before_cut(path, skip, separator, len(names))
    return Dialect(separator, decimal_comma, skip, tuple(names), named, text, dated, rows)


def _count_rows_before_cut(path: Path, skip: int, separator: str, columns: int) -> int | None:
    """Return how many rows precede a last line that lacks cells and its end; None if none does."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - LONGEST_LINE))
        last = file.read().rpartition(b"\n")[2].decode("utf-8", "replace")
        if not last.strip() or len(_split_fields(last, separator)) >= columns:
            return None
        file.seek(0)
        lines = (line for k, line in enumerate(file) if k >= skip)
        rows = sum(not line.startswith(b"#") for line in lines) - 1
    return rows if rows > 0 else None


def _is_header(fields: list[str], rows: list[list[str]], is_number: Callable[[str], bool]) -> bool:
    """Return whether the first line names the columns, by the lines after it."""
    numeric = [is_number(field) for field in fields]
    if all(numeric) or not any(numeric):
        return not any(numeric)
    counted = [float(field) for field in fields if is_number(field)]
    counts = any(counted == [float(k + n) for k in range(len(counted))] for n in (0, 1))
    alike = [[is_number(field) or field in _MISSING for field in row] == numeric for row in rows]
    return counts or not rows or not all(alike)


def _detect_dialect(path: Path, sheet: RecordingSheet) -> Dialect | None:
    """Return how a file is written, as far as its sheet does not say; None for an echoed topic."""
    if sheet.header is None and sheet.separator is None:
        first = next((line for line in _read_first_lines(path) if line.strip()), "")
        if is_topic_echo(first):
            return None
    separator = "" if sheet.separator == " " else sheet.separator
    return find_dialect(
        path, header=sheet.header, separator=separator, numbered=sheet.columns.numbered
    )


def scan_delimited(path: Path, dialect: Dialect, text: bytes | None = None) -> pl.LazyFrame:
    """Open the file lazily, or a part of its rows: numeric columns Float64, text columns String."""
    schema = {
        name: pl.String if name in dialect.text_columns else pl.Float64 for name in dialect.names
    }
    # Polars counts columns by the first row, which may lack cells
    whole_row = dialect.separator.join("0" * len(dialect.names)).encode() + b"\n"
    scanned = pl.scan_csv(
        path if text is None else whole_row + text,
        separator=dialect.separator,
        has_header=False,
        skip_lines=dialect.skip if text is None else 0,
        schema=schema,
        comment_prefix="#" if text is None and _holds(path, b"#") else None,
        null_values=_MISSING,
        decimal_comma=dialect.decimal_comma,
        n_rows=dialect.rows if text is None else None,
    )
    return scanned if text is None else scanned.slice(1)


def _holds(path: Path, sign: bytes) -> bool:
    """Return whether a file holds a sign; Polars takes half as long again to look for comments."""
    with path.open("rb") as file:
        return any(sign in part for part in iter(lambda: file.read(AT_ONCE), b""))


def _read_parts(path: Path, dialect: Dialect) -> Iterator[bytes]:
    """Yield the rows of a file without quotes, some at a time, but for comments and a cut one."""

    def without_comments(rows: bytes) -> bytes:
        if b"#" not in rows:
            return rows
        return b"".join(line for line in rows.splitlines(True) if not line.startswith(b"#"))

    with path.open("rb") as file:
        for _ in range(dialect.skip):
            file.readline()
        begun = b"" if dialect.skip else file.read(len(BOM_UTF8)).removeprefix(BOM_UTF8)
        for read in iter(lambda: file.read(AT_ONCE), b""):
            whole, end, begun = (begun + read).rpartition(b"\n")
            rows = without_comments(whole + end)
            if rows.strip():
                yield rows
        begun = without_comments(begun)
        if begun.strip() and dialect.rows is None:
            yield begun


def without_blank_lines(frame: pl.LazyFrame) -> pl.LazyFrame:
    """Leave out the rows in which every cell is empty."""
    return frame.filter(~pl.all_horizontal(pl.all().is_null()))


def read_delimited(path: Path, dialect: Dialect | None = None) -> LogTable:
    """Read a text file delimited by commas, semicolons, tabs, bars or blanks.

    Empty cells become NaN, dates and times seconds; a cell that is neither raises with its line
    and column.

    Raises
    ------
    RecordingError
        If the file is not a table of numbers.
    """
    dialect = find_dialect(path) if dialect is None else dialect
    if dialect.separator == "":
        return _read_blank_delimited(path, dialect)
    numbers = _read_small_numbers(path, dialect)
    if numbers is not None:
        return replace(_make_header(path, dialect), columns=numbers)
    try:
        frame = without_blank_lines(scan_delimited(path, dialect)).collect()
    except pl.exceptions.PolarsError as error:
        raise locate_bad_cell(path, dialect, error) from error
    frame = _convert_times(path, frame, dialect).select(dialect.numeric)
    return replace(_make_header(path, dialect), columns=list_columns(frame))


def _read_small_numbers(path: Path, dialect: Dialect) -> dict[str, Array] | None:
    """Return the columns of a small table of nothing but numbers, to the same bits; else None."""
    plain = not dialect.text_columns and not dialect.decimal_comma and dialect.rows is None
    if not plain or path.stat().st_size > SMALL:
        return None
    try:
        rows = np.loadtxt(
            path,
            delimiter=dialect.separator,
            skiprows=dialect.skip,
            comments=None,
            encoding="utf-8",
            ndmin=2,
        )
    except ValueError:
        # Missing cells, quotes, comments and lines of another length, of which polars knows.
        return None
    if rows.shape[1] != len(dialect.names):
        return None
    return dict(zip(dialect.names, np.ascontiguousarray(rows.T), strict=True))


def _make_header(path: Path, dialect: Dialect) -> LogTable:
    """Return the table of a file without its rows."""
    return LogTable(
        source=str(path),
        columns={name: np.empty(0) for name in dialect.numeric},
        named=dialect.named,
        text_columns=tuple(name for name in dialect.names if name not in dialect.numeric),
        notes=() if dialect.rows is None else ("the last line is cut and was left out",),
        order=dialect.names,
    )


def _convert_times(path: Path, frame: pl.DataFrame, dialect: Dialect) -> pl.DataFrame:
    """Return a frame whose columns of dates and times are seconds."""
    times = []
    for name in set(dialect.dated) & set(frame.columns):
        seconds = parse_times(frame[name])
        if seconds is None:
            raise locate_bad_cell(path, dialect, ValueError(f"column {name!r} holds no times"))
        times.append(pl.Series(name, seconds))
    return frame.with_columns(times)


def locate_bad_cell(path: Path, dialect: Dialect, error: Exception) -> RecordingError:
    """Return the error that names the first cell that is not a number."""
    expected = len(dialect.names)
    with path.open(encoding="utf-8", errors="replace") as file:
        for line, text in enumerate(file, start=1):
            if line <= dialect.skip or not text.strip() or text.startswith("#"):
                continue
            fields = _split_fields(text, dialect.separator)
            if len(fields) > expected:
                commas = dialect.separator == "," and len(fields) > 1.5 * expected
                return RecordingError(
                    f"{path}, line {line}: {len(fields)} fields where {expected} columns are"
                    " expected",
                    cure=Cure(
                        "export decimal points, or semicolons between the cells, if these are"
                        " decimal commas"
                        if commas
                        else "repair or remove the line"
                    ),
                    file=str(path),
                    line=line,
                )
            for name, cell in zip(dialect.names, fields, strict=False):
                if cell in _MISSING or name not in dialect.numeric:
                    continue
                dated = name in dialect.dated
                if (
                    parse_times(pl.Series([cell])) is None
                    if dated
                    else not _is_number(cell, dialect.decimal_comma)
                ):
                    what = "date or time" if dated else "number"
                    return RecordingError(
                        f"{path}, line {line}, column {name!r}: {cell!r} is not a {what}",
                        cure=Cure("repair the cell or remove the line"),
                        file=str(path),
                        line=line,
                        column=name,
                        value=cell,
                    )
    return RecordingError(f"{path} cannot be read as delimited text: {error}", file=str(path))


def _read_blank_delimited(path: Path, dialect: Dialect) -> LogTable:
    try:
        data = np.loadtxt(
            path,
            comments=list(_COMMENTS),
            encoding="utf-8-sig",
            skiprows=dialect.skip,
            max_rows=dialect.rows,
            ndmin=2,
        )
    except ValueError as error:
        raise RecordingError(
            f"{path} cannot be read as numbers between blanks: {error}", file=str(path)
        ) from error
    columns = {name: np.ascontiguousarray(data[:, k]) for k, name in enumerate(dialect.names)}
    return replace(_make_header(path, dialect), columns=columns)


def _find_no_text(start: bytes) -> tuple[str, Cure | None] | None:
    """Return why a file that begins so is no table of text, and what to do; None if it may be."""
    for magic, (packed, cure) in _PACKED.items():
        if start.startswith(magic):
            return f"it holds {packed}", Cure(cure)
    if b"\r" in start and b"\n" not in start:
        return "its lines end in a carriage return alone", Cure("save it with line feeds")
    if b"\0" in start:
        return "it holds binary data, not text", None
    begins = start.lstrip()[:20].decode("utf-8", "replace")
    if begins.lower().startswith(("<!doctype", "<html", "<?xml", "<robot", "{")):
        return f"it starts with {begins!r}, not a table of numbers", None
    return None


def _read_first_lines(path: Path) -> list[str]:
    with path.open("rb") as file:
        start = file.read(4096)
    if problem := _find_no_text(start):
        what, cure = problem
        raise RecordingError(f"{path} is not a recording: {what}", cure=cure, file=str(path))
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = [file.readline(LONGEST_LINE) for _ in range(FIRST_LINES)]
    if any(len(line) == LONGEST_LINE for line in lines):
        raise RecordingError(
            f"{path} is not a recording: it has a line of {LONGEST_LINE} characters or more",
            file=str(path),
        )
    return [line for line in lines if line]


def _find_separator(lines: list[str]) -> str:
    for separator in (";", "\t", "|", ","):
        counts = {line.count(separator) for line in lines}
        if len(counts) == 1 and counts != {0}:
            return separator
    for separator in (",", ";", "\t", "|"):
        if sum(separator in line for line in lines) > len(lines) // 2:
            return separator
    return "" if all(len(line.split()) > 1 for line in lines) else ","


def _split_fields(line: str, separator: str) -> list[str]:
    parts = line.strip("\r\n").split(separator) if separator else line.split()
    return [part.strip().strip('"').strip() for part in parts]


def _is_number(text: str, decimal_comma: bool) -> bool:
    try:
        float(text.replace(",", ".") if decimal_comma else text)
    except ValueError:
        return False
    return True


def _open_stream(path: Path, sheet: RecordingSheet) -> LogStream | None:
    """Open a file that can be read lazily; None for blanks between the cells and echoed topics."""
    dialect = _detect_dialect(path, sheet)
    if dialect is None or dialect.separator == "":
        return None
    return LogStream(_make_header(path, dialect), partial(_read_chunks, path, dialect))


def _read_chunks(
    path: Path, dialect: Dialect, columns: Sequence[str], chunk_samples: int
) -> Iterator[tuple[int, dict[str, Array]]]:
    # Polars reads far ahead of what is asked for; rows in quotes may span lines, which it must find
    parts = [None] if _holds(path, b'"') else _read_parts(path, dialect)
    done = 0
    held = pl.DataFrame()
    try:
        for part in parts:
            rows = without_blank_lines(scan_delimited(path, dialect, part).select(columns))
            for batch in rows.collect_batches(chunk_size=chunk_samples, maintain_order=True):
                held = pl.concat([held, batch]) if held.height else batch
                while held.height > chunk_samples:
                    yield done, list_columns(_convert_times(path, held[:chunk_samples], dialect))
                    done = done + chunk_samples
                    held = held[chunk_samples:]
    except pl.exceptions.PolarsError as error:
        raise locate_bad_cell(path, dialect, error) from error
    if held.height:
        yield done, list_columns(_convert_times(path, held, dialect))


def _read(path: Path, sheet: RecordingSheet) -> LogTable:
    dialect = _detect_dialect(path, sheet)
    return read_topic_echo(path) if dialect is None else read_delimited(path, dialect)


FORMATS.register(
    "delimited",
    LogFormat(
        suffixes=(".csv", ".dat", ".tsv", ".txt"),
        read=_read,
        stream=_open_stream,
        n_bytes=lambda path: path.stat().st_size,
    ),
)
