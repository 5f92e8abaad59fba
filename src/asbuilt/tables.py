"""Tables in text, HTML and CSV, and values rounded to what their errors allow.

A `Table` holds the numbers themselves; text and HTML show them rounded, CSV writes them in full.
"""

from __future__ import annotations

import csv
import html
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import compress
from operator import attrgetter
from typing import Any, Literal

Alignment = Literal["left", "right", "decimal"]

WIDTH = 80
"""Columns of a terminal, which short texts fit."""

MISSING = "-"
"""Text of a cell without a number."""

SIGNIFICANT_SIGMAS = 3.0
"""Standard errors from which a difference is significant."""


@dataclass(frozen=True, slots=True)
class Shown:
    """Hold a number and the text that is printed for it."""

    value: float | None
    text: str


Cell = str | int | float | Shown | None


def round_with_error(value: float, error: float | None) -> tuple[str, str]:
    """Round a value and its standard error to the error's second significant digit.

    Both share their last digit, and beyond seven decimals their exponent. Without a usable error
    the value has six significant digits. Source: the usual rule of metrology (GUM, JCGM 100:2008,
    7.2.6).

    >>> round_with_error(0.0309871, 0.00412)
    ('0.0310', '0.0041')
    >>> round_with_error(6.2048, 0.0996)
    ('6.20', '0.10')
    >>> round_with_error(2.5e-10, 3e-12)
    ('2.500e-10', '0.030e-10')
    """
    if not math.isfinite(value):
        return MISSING, MISSING if error is None or not math.isfinite(error) else f"{error:.1e}"
    if error is None or not math.isfinite(error) or error <= 0:
        return f"{value + 0.0:.6g}", "0" if error == 0 else MISSING
    decimals = 1 - int(f"{error:.1e}".split("e")[1])
    # Decimals up to which a number is written out before it takes an exponent.
    if decimals > 7:
        lead = max(abs(value), error)
        exponent = int(f"{lead:.{max(0, decimals + math.floor(math.log10(lead)))}e}".split("e")[1])
        kept = decimals + exponent
        lifted = Decimal(value).scaleb(-exponent)
        uncertainty = Decimal(error).scaleb(-exponent)
        power = f"e{exponent:+03d}" if exponent else ""
        return f"{lifted:z.{kept}f}{power}", f"{uncertainty:.{kept}f}{power}"
    if decimals < 0:
        step = 10.0**-decimals
        value = round(value / step) * step
        error = round(error / step) * step
        decimals = 0
    # z: no minus before a zero.
    return f"{value:z.{decimals}f}", f"{error:.{decimals}f}"


def format_plus_minus(value: float, error: float | None) -> str:
    """Return value and standard error as one text.

    >>> format_plus_minus(0.0309871, 0.00412)
    '0.0310 +/- 0.0041'
    """
    shown, uncertainty = round_with_error(value, error)
    return shown if uncertainty == MISSING else f"{shown} +/- {uncertainty}"


def format_estimate(value: float, error: float | None) -> tuple[Shown, Shown, Shown]:
    """Return the cells of a value, its standard error, and this in percent of the value."""
    shown, uncertainty = round_with_error(value, error)
    relative = None if error is None or not value else 100.0 * abs(error / value)
    return (
        Shown(value, shown),
        Shown(error, uncertainty),
        Shown(relative, format_percent(value, error)),
    )


def format_percent(value: float, error: float | None) -> str:
    """Return the relative standard error 100 |error / value|, a dash where it has no meaning.

    >>> format_percent(0.031, 0.0041), format_percent(1e-5, 1.0), format_percent(0.0, 1.0)
    ('13.2', '>999', '-')
    """
    if error is None or not math.isfinite(error) or not math.isfinite(value) or value == 0:
        return MISSING
    share = 100.0 * abs(error / value)
    return ">999" if share > 999 else f"{share:.1f}"


def format_share(fraction: float | None, digits: int = 1) -> str:
    """Return a fraction as a percentage with its sign.

    >>> format_share(0.0187)
    '1.9 %'
    """
    return (
        MISSING
        if fraction is None or not math.isfinite(fraction)
        else f"{100.0 * fraction:z.{digits}f} %"
    )


def round_beside(value: float, error: float | None) -> str:
    """Round a number for printing next to another of standard error `error`.

    It keeps four significant digits, fewer if it is far below the error.

    >>> round_beside(0.023661, 0.4), round_beside(6.666386, 0.0023), round_beside(1e-9, 0.4)
    ('0.02366', '6.666', '0.0000')
    """
    if error is None or not math.isfinite(error) or abs(value) >= 1e-3 * error:
        return round_significant(value, 4)
    return round_with_error(value, 1e-2 * error)[0]


def round_significant(value: float | None, digits: int = 3) -> str:
    """Round a number to significant digits; only very large and small ones take an exponent.

    >>> tuple(round_significant(each) for each in (61.2943, 0.000123456, 69386.0, None))
    ('61.3', '0.000123', '69400', '-')
    >>> round_significant(1234567.0)
    '1.23e+06'
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -5 < exponent < 6:
        return f"{value:.{digits - 1}e}"
    return f"{float(f'{value:.{digits - 1}e}'):.{max(0, digits - 1 - exponent)}f}"


def format_range(least: float, greatest: float, unit: str = "") -> str:
    """Return an interval with its unit as text, ends that are infinite in words.

    >>> format_range(3.884, math.inf, "kg"), format_range(0.0, 0.0945, "kg m^2")
    ('3.88 kg or more', '0 to 0.0945 kg m^2')
    """
    low = round_significant(least)
    high = round_significant(greatest)
    unit = f" {unit}".rstrip()
    if math.isinf(least) and math.isinf(greatest):
        return "any value"
    if math.isinf(greatest):
        return f"{low}{unit} or more"
    return f"{high}{unit} or less" if math.isinf(least) else f"{low} to {high}{unit}"


def format_deviation(sigmas: float | None, threshold: float = SIGNIFICANT_SIGMAS) -> str:
    """Return a difference in standard errors, "DIFFERS" from the threshold on.

    >>> tuple(format_deviation(each) for each in (1.83, -57.0, -0.01, None))
    ('+1.8 sigma', 'DIFFERS', '0.0 sigma', '-')
    """
    if sigmas is None or math.isnan(sigmas):
        return MISSING
    if abs(sigmas) >= threshold:
        return "DIFFERS"
    return "0.0 sigma" if abs(sigmas) < 0.05 else f"{sigmas:+.1f} sigma"


def shorten_text(text: str, width: int) -> str:
    """Cut a text at a space so that it fits the width with three dots.

    >>> shorten_text("mz2 - my3 + 0.4 m3 + 0.4 m4", 23)
    'mz2 - my3 + 0.4 m3 ...'
    """
    if len(text) <= width:
        return text
    head, space, _ = text[: max(0, width - 3)].rpartition(" ")
    if not space:
        return text[: max(0, width - 3)] + "..."
    return head.rstrip(" +-") + " ..."


def preformat(text: str) -> str:
    """Return text of fixed-width characters as HTML whose lines a notebook does not break."""
    style = "white-space: pre; overflow-x: auto; font-size: 0.85em; line-height: 1.4"
    return f'<pre style="{style}">{html.escape(text)}</pre>'


def wrap_text(text: str, first: str = "", *, lines: int | None = None) -> str:
    """Break a text at spaces into lines of 80 columns, the later ones indented below the first.

    Parameters
    ----------
    text
        One paragraph.
    first
        Label at the start of the first line.
    lines
        Most lines; a longer text ends in " ...".

    >>> print(wrap_text("Standard errors are from blocks. " * 3, "[1] ", lines=1))
    [1] Standard errors are from blocks. Standard errors are from blocks. ...
    """
    unbroken = _replace_unprintable(text).replace(" %", "\u00a0%")  # a number stays with its sign
    return textwrap.fill(
        unbroken,
        WIDTH,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        max_lines=lines,
        placeholder=" ...",
        break_on_hyphens=False,
    ).replace("\u00a0", " ")


def number_notes(notes: Iterable[str]) -> list[str]:
    """Return notes as wrapped lines, `[1]`, `[2]` and so on before each."""
    return [wrap_text(note, f"[{number}] ") for number, note in enumerate(notes, start=1)]


@dataclass(frozen=True, slots=True)
class Column:
    """Describe one column of a table.

    Parameters
    ----------
    header, unit
        Head of the column.
    align
        Alignment in text; "decimal" aligns decimal points.
    style
        Format of a float that comes without its own text, its significant digits, or a function
        that writes it.
    width
        Most characters in text; HTML and CSV have long cells whole.
    detail
        Whether a short text leaves the column out.
    of
        What the column shows of an item, for `Table.of`: a function of it, or its attribute.
    """

    header: str
    unit: str = ""
    align: Alignment = "left"
    style: str | int | Callable[[float], str] = ".6g"
    width: int | None = None
    detail: bool = False
    of: Callable[[Any], Cell] | str = ""

    def shown(self, cell: Cell) -> str:
        """Return the printed form of a cell."""
        if isinstance(cell, Shown):
            return cell.text
        if isinstance(cell, str | int):
            return str(cell)
        if cell is None or not math.isfinite(cell):
            return MISSING
        if isinstance(self.style, str):
            return format(cell + 0.0, self.style)
        return (
            round_significant(cell, self.style) if isinstance(self.style, int) else self.style(cell)
        )


@dataclass(frozen=True)
class Table:
    """Hold rows of cells below columns.

    Parameters
    ----------
    columns, rows
        Heads and cells; every row has a cell for each column.
    title
        Line above the heads.
    notes
        Sentences below the table, numbered.
    details
        Further notes that a short text leaves out, such as definitions of the columns.
    important
        Places of the rows that a short text shows; None: all.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    title: str = ""
    notes: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    important: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {number} of table {self.title!r} has {len(row)} cells for"
                    f" {len(self.columns)} columns: {row}"
                )

    @classmethod
    def of(
        cls, items: Iterable[Any], columns: Sequence[Column], title: str = "", **rest: Any
    ) -> Table:
        """Return the table with a row for each item, its cells by the `of` of the columns.

        >>> columns = [Column("part", of="real"), Column("size", of=abs, style=3)]
        >>> Table.of([1 + 2j], columns).as_csv().split()
        ['part,size', '1.0,2.23606797749979']
        """
        cells = [
            attrgetter(column.of) if isinstance(column.of, str) else column.of for column in columns
        ]
        rows = tuple(tuple(cell(item) for cell in cells) for item in items)
        return cls(tuple(columns), rows, title, **rest)

    def filled(self) -> Table:
        """Return the table without the columns that no row fills."""
        kept = [any(cell is not None for cell in cells) for cells in zip(*self.rows, strict=True)]
        return replace(
            self,
            columns=tuple(compress(self.columns, kept)),
            rows=tuple(tuple(compress(row, kept)) for row in self.rows),
        )

    def __str__(self) -> str:
        return self.as_text()

    def _repr_html_(self) -> str:
        return self.as_html()

    def as_text(self, full: bool = False, most: int | None = None) -> str:
        """Return the table in fixed-width characters, lines ending in a newline.

        Names that do not fit are numbered, with a legend below: nothing is cut in the middle.

        Parameters
        ----------
        full
            Show all rows, columns and notes whatever their width; else fit 80 columns.
        most
            Rows shown; None: all that a short text shows.
        """
        places = range(len(self.rows)) if full or self.important is None else self.important
        rows = [self.rows[place] for place in places][:most]
        shown = [k for k, column in enumerate(self.columns) if full or not column.detail]
        columns = [self.columns[k] for k in shown]
        cells = [
            [_replace_unprintable(self.columns[k].shown(row[k])) for row in rows] for k in shown
        ]
        legend = [] if full else _number_names(cells, columns)
        if not full:
            cells = [
                [shorten_text(text, column.width or len(text)) for text in texts]
                for texts, column in zip(cells, columns, strict=True)
            ]
        cells = [
            _align_cells(texts, column.align) for texts, column in zip(cells, columns, strict=True)
        ]
        widths = _measure_columns(cells, columns)
        if not full:
            widths = _narrow_columns(widths, columns)
        lines = [self.title if full else wrap_text(self.title)] if self.title else []
        lines.append(_format_line([column.header for column in columns], widths, columns))
        if any(column.unit for column in columns):
            lines.append(_format_line([column.unit for column in columns], widths, columns))
        lines.append("-" * (sum(widths) + 2 * (len(widths) - 1)))
        lines += [_format_line(row, widths, columns) for row in zip(*cells, strict=True)]
        if len(rows) < len(self.rows):
            lines.append(f"... {len(self.rows) - len(rows)} more rows")
        lines += legend
        lines += number_notes((*self.notes, *(self.details if full else ())))
        return "".join(f"{line.rstrip()}\n" for line in lines)

    def as_html(self, identifier: str = "") -> str:
        """Return the table as an HTML `table` element.

        Every text is escaped, and numbers carry their full value in `data-value`.
        """
        label = f' id="{html.escape(identifier)}"' if identifier else ""
        caption = f"<caption>{html.escape(self.title)}</caption>" if self.title else ""
        head = "".join(map(_write_html_head, self.columns))
        body = "".join(
            "<tr>"
            + "".join(
                _write_html_cell(column, cell)
                for column, cell in zip(self.columns, row, strict=True)
            )
            + "</tr>\n"
            for row in self.rows
        )
        notes = "".join(
            f"<p>[{number}] {html.escape(note)}</p>"
            for number, note in enumerate((*self.notes, *self.details), start=1)
        )
        table = (
            f'<table class="numbers"{label}>{caption}<thead><tr>{head}</tr></thead>\n'
            f"<tbody>\n{body}</tbody></table>"
        )
        return table + (f'\n<div class="notes">{notes}</div>' if notes else "")

    def as_csv(self) -> str:
        """Return the table as CSV with units in brackets in the header and numbers in full."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            [
                f"{column.header} [{column.unit}]" if column.unit else column.header
                for column in self.columns
            ]
        )
        for row in self.rows:
            writer.writerow([_write_in_full(c.value if isinstance(c, Shown) else c) for c in row])
        return stream.getvalue()


def stack_tables(tables: Iterable[Table], full: bool = False) -> str:
    """Return the texts of several tables with an empty line between them."""
    return "\n".join(table.as_text(full) for table in tables)


def _replace_unprintable(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


def _number_names(cells: list[list[str]], columns: Sequence[Column]) -> list[str]:
    """Replace names that do not fit their column by numbers; return the lines of a legend.

    `cells` are the texts by column. A name is a text without spaces, which could only be cut in the
    middle.
    """
    fitted = _narrow_columns(_measure_columns(cells, columns), columns)
    legend = list[str]()
    for texts, column, width in zip(cells, columns, fitted, strict=True):
        room = min(width, column.width or WIDTH)
        names = list(dict.fromkeys(texts))
        if column.align != "left" or all(len(name) <= room or " " in name for name in names):
            continue
        number = {name: str(at) for at, name in enumerate(names, start=1) if " " not in name}
        texts[:] = [number.get(text, text) for text in texts]
        listed = ", ".join(f"{at} {name}" for name, at in number.items())
        legend.append(wrap_text(listed, f"{column.header}: "))
    return legend


def _measure_columns(cells: Sequence[Sequence[str]], columns: Sequence[Column]) -> list[int]:
    """Return how wide columns are with their heads."""
    return [
        max(map(len, (column.header, column.unit, *texts)))
        for texts, column in zip(cells, columns, strict=True)
    ]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _align_cells(cells: Sequence[str], align: Alignment) -> list[str]:
    """Pad numbers so that their decimal points are in one column."""
    numbers = [cell for cell in cells if _is_number(cell)]
    if align != "decimal" or not numbers:
        return list(cells)
    after = max(len(number) - len(number.partition(".")[0]) for number in numbers)
    return [
        f"{cell:<{len(cell.partition('.')[0]) + after}}"
        if cell == MISSING or _is_number(cell)
        else cell
        for cell in cells
    ]


def _narrow_columns(widths: Sequence[int], columns: Sequence[Column]) -> list[int]:
    """Narrow the widest columns of text until the table fits 80 columns, where possible."""
    fitted = list(widths)
    places = [k for k, column in enumerate(columns) if column.align == "left"]
    while sum(fitted) + 2 * (len(fitted) - 1) > WIDTH and places:
        widest = max(places, key=lambda k: fitted[k])
        # Characters below which a column is not narrowed to make a short text fit.
        if fitted[widest] <= max(12, len(columns[widest].header)):
            break
        fitted[widest] -= 1
    return fitted


def _format_line(cells: Sequence[str], widths: Sequence[int], columns: Sequence[Column]) -> str:
    return "  ".join(
        shorten_text(cell, width).ljust(width) if column.align == "left" else cell.rjust(width)
        for cell, width, column in zip(cells, widths, columns, strict=True)
    )


def _write_html_class(column: Column) -> str:
    return "" if column.align == "left" else ' class="number"'


def _write_html_head(column: Column) -> str:
    # A long header may break after underscores.
    broken = "_<wbr>" if len(column.header) > 8 else "_"
    unit = f' <span class="unit">{html.escape(column.unit)}</span>' if column.unit else ""
    name = html.escape(column.header).replace("_", broken)
    return f'<th scope="col"{_write_html_class(column)}>{name}{unit}</th>'


def _write_html_cell(column: Column, cell: Cell) -> str:
    value = cell.value if isinstance(cell, Shown) else cell
    full = "" if isinstance(value, str) else _write_in_full(value)
    data = f' data-value="{full}"' if full else ""
    return f"<td{_write_html_class(column)}{data}>{html.escape(column.shown(cell))}</td>"


def _write_in_full(value: str | float | None) -> str:
    """Return a number with all its digits, a text as it is, nothing where there is neither."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)
