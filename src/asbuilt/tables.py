"""Fixed-width tables, and values rounded to what their errors allow; knows no robots.

A `Table` holds the numbers themselves; text and HTML show them rounded, CSV writes them in full.
"""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

Alignment = Literal["left", "right", "center", "decimal"]
MISSING = "-"
"""What stands where there is no number."""

SHORT_HEADER = 8
"""Characters up to which a header in HTML stays on one line."""

FIXED_DIGITS = 7
"""Decimals up to which a number is written out before it takes an exponent."""

SIGNIFICANT_SIGMAS = 3.0
"""A difference of this many standard errors is called a difference."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A number and the text that stands for it where the table is printed."""

    value: float | None
    text: str


Cell = str | int | float | Shown | None


def rounded(value: float, error: float | None) -> tuple[str, str]:
    """Round a value and its standard error to the error's second significant digit.

    Both share their last digit, and beyond seven decimals their exponent. Without a usable error
    the value has six significant digits. Source: the usual rule of metrology (GUM, JCGM 100:2008,
    7.2.6).

    >>> rounded(0.0309871, 0.00412)
    ('0.0310', '0.0041')
    >>> rounded(6.2048, 0.0996)
    ('6.20', '0.10')
    >>> rounded(2.5e-10, 3e-12)
    ('2.500e-10', '0.030e-10')
    """
    if not math.isfinite(value):
        return MISSING, MISSING if error is None or not math.isfinite(error) else f"{error:.1e}"
    if error is None or not math.isfinite(error) or error <= 0:
        return f"{value + 0.0:.6g}", "0" if error == 0 else MISSING
    decimals = 1 - int(f"{error:.1e}".split("e")[1])
    if decimals > FIXED_DIGITS:
        lead = max(abs(value), error)
        exponent = int(f"{lead:.{max(0, decimals + math.floor(math.log10(lead)))}e}".split("e")[1])
        kept = decimals + exponent
        lifted, uncertainty = Decimal(value).scaleb(-exponent), Decimal(error).scaleb(-exponent)
        power = f"e{exponent:+03d}" if exponent else ""
        return f"{_signless(lifted, kept)}{power}", f"{uncertainty:.{kept}f}{power}"
    if decimals < 0:
        step = 10.0**-decimals
        value, error, decimals = round(value / step) * step, round(error / step) * step, 0
    return _signless(value, decimals), f"{error:.{decimals}f}"


def plus_minus(value: float, error: float | None) -> str:
    """Return value and standard error as one text.

    >>> plus_minus(0.0309871, 0.00412)
    '0.0310 +/- 0.0041'
    """
    shown, uncertainty = rounded(value, error)
    return shown if uncertainty == MISSING else f"{shown} +/- {uncertainty}"


def percent(value: float, error: float | None) -> str:
    """Return the relative standard error 100 |error / value|, a dash where it has no meaning.

    >>> percent(0.031, 0.0041), percent(1e-5, 1.0), percent(0.0, 1.0)
    ('13.2', '>999', '-')
    """
    if error is None or not math.isfinite(error) or not math.isfinite(value) or value == 0:
        return MISSING
    share = 100.0 * abs(error / value)
    return ">999" if share > 999 else f"{share:.1f}"


def share(fraction: float | None, digits: int = 1) -> str:
    """Return a fraction as a percentage with its sign.

    >>> share(0.0187)
    '1.9 %'
    """
    return (
        MISSING
        if fraction is None or not math.isfinite(fraction)
        else f"{_signless(100.0 * fraction, digits)} %"
    )


def beside(value: float, error: float | None) -> str:
    """Return a number that stands beside another of standard error `error`.

    Four digits of its own, fewer where it is far below the error.

    >>> beside(0.023661, 0.4), beside(6.666386, 0.0023), beside(1e-9, 0.4)
    ('0.02366', '6.666', '0.0000')
    """
    if error is None or not math.isfinite(error) or abs(value) >= 1e-3 * error:
        return significant(value, 4)
    return rounded(value, 1e-2 * error)[0]


def significant(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, written out where it is of everyday size.

    >>> significant(61.2943), significant(0.000123456), significant(69386.0), significant(1234567.0), significant(None)
    ('61.3', '0.000123', '69400', '1.23e+06', '-')
    """
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -5 < exponent < 6:
        return f"{value:.{digits - 1}e}"
    return f"{float(f'{value:.{digits - 1}e}'):.{max(0, digits - 1 - exponent)}f}"


def deviation(sigmas: float | None, threshold: float = SIGNIFICANT_SIGMAS) -> str:
    """Return a difference in standard errors, in words where it is beyond doubt.

    >>> deviation(1.83), deviation(-57.0), deviation(None)
    ('+1.8 sigma', 'DIFFERS', '-')
    """
    if sigmas is None or math.isnan(sigmas):
        return MISSING
    return "DIFFERS" if abs(sigmas) >= threshold else f"{sigmas:+.1f} sigma"


def shortened(text: str, width: int) -> str:
    """Cut a text at a space so that it and three dots fit the width.

    >>> shortened("mz2 - my3 + 0.4 m3 + 0.4 m4", 23)
    'mz2 - my3 + 0.4 m3 ...'
    """
    if len(text) <= width:
        return text
    room = width - 4
    if room <= 0 or " " not in text[: room + 1]:
        return text[: max(0, width - 3)] + "..."
    head = text[: room + 1]
    return head[: head.rindex(" ")].rstrip(" +-") + " ..."


@dataclass(frozen=True, slots=True)
class Column:
    """One column: header, unit, alignment, and how a float that comes without its own text is
    printed.

    `width` limits what text shows of a long cell; HTML and CSV have it whole.
    """

    header: str
    unit: str = ""
    align: Alignment = "left"
    style: str | Callable[[float], str] = ".6g"
    width: int | None = None

    def shown(self, cell: Cell) -> str:
        """Return the printed form of a cell."""
        if cell is None:
            return MISSING
        if isinstance(cell, Shown):
            return cell.text
        if isinstance(cell, str):
            return cell
        if isinstance(cell, int):
            return str(cell)
        if not math.isfinite(cell):
            return MISSING
        return self.style(cell) if callable(self.style) else format(cell + 0.0, self.style)


@dataclass(frozen=True)
class Table:
    """Hold rows of cells under columns, with a title above and numbered notes below."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    title: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", tuple(self.columns))
        object.__setattr__(self, "rows", tuple(tuple(row) for row in self.rows))
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {number} of table {self.title!r} has {len(row)} cells for"
                    f" {len(self.columns)} columns: {row}"
                )

    def __str__(self) -> str:
        return self.as_text()

    def as_text(self) -> str:
        """Return the table in fixed-width characters, no trailing spaces, lines ending in a
        newline.
        """
        body = [
            [
                _clipped(_plain(column.shown(cell)), column.width)
                for column, cell in zip(self.columns, row, strict=True)
            ]
            for row in self.rows
        ]
        cells = [
            _aligned([row[k] for row in body], column.align)
            for k, column in enumerate(self.columns)
        ]
        widths = [
            max([len(column.header), len(column.unit)] + [len(cell) for cell in cells[k]])
            for k, column in enumerate(self.columns)
        ]
        heads = [[column.header for column in self.columns]]
        if any(column.unit for column in self.columns):
            heads.append([column.unit for column in self.columns])
        lines = [self.title] if self.title else []
        lines += [_line(head, widths, self.columns) for head in heads]
        lines.append("-" * (sum(widths) + 2 * (len(widths) - 1)))
        lines += [
            _line([cells[k][i] for k in range(len(self.columns))], widths, self.columns)
            for i in range(len(body))
        ]
        lines += [f"[{number}] {note}" for number, note in enumerate(self.notes, start=1)]
        return "".join(line.rstrip() + "\n" for line in lines)

    def as_html(self, identifier: str = "") -> str:
        """Return the table as an HTML `table` element.

        Every text is escaped, numbers carry their full value in `data-value`.
        """
        label = f' id="{html.escape(identifier)}"' if identifier else ""
        caption = f"<caption>{html.escape(self.title)}</caption>" if self.title else ""
        head = "".join(
            f'<th scope="col"{_html_class(column)}>{_breakable(column.header)}'
            + (f' <span class="unit">{html.escape(column.unit)}</span>' if column.unit else "")
            + "</th>"
            for column in self.columns
        )
        body = "".join(
            "<tr>"
            + "".join(
                _html_cell(column, cell) for column, cell in zip(self.columns, row, strict=True)
            )
            + "</tr>\n"
            for row in self.rows
        )
        notes = "".join(
            f"<p>[{number}] {html.escape(note)}</p>"
            for number, note in enumerate(self.notes, start=1)
        )
        table = (
            "<table"
            f' class="numbers"{label}>{caption}<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table>'
        )
        return table + (f'\n<div class="notes">{notes}</div>' if notes else "")

    def as_csv(self) -> str:
        """Return the table as CSV.

        One header row with units in brackets, numbers in full, empty where there is none.
        """
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            [
                f"{column.header} [{column.unit}]" if column.unit else column.header
                for column in self.columns
            ]
        )
        for row in self.rows:
            writer.writerow([_csv_cell(cell) for cell in row])
        return stream.getvalue()


def columns(*specifications: Column | str) -> tuple[Column, ...]:
    """Return columns, a bare text standing for a left-aligned column of that name."""
    return tuple(Column(item) if isinstance(item, str) else item for item in specifications)


def stacked(tables: Iterable[Table]) -> str:
    """Return the texts of several tables, an empty line between them."""
    return "\n".join(table.as_text() for table in tables)


def _signless(value: float | Decimal, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return (
        text[1:]
        if text.startswith("-") and not any(digit in text for digit in "123456789")
        else text
    )


def _plain(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


def _clipped(text: str, width: int | None) -> str:
    return text if width is None else shortened(text, width)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _aligned(cells: Sequence[str], align: Alignment) -> list[str]:
    if align != "decimal":
        return list(cells)
    parts = [cell.partition(".") if _is_number(cell) else ("", "", "") for cell in cells]
    before = max((len(head) for head, _, _ in parts), default=0)
    after = max((len(point + tail) for _, point, tail in parts), default=0)
    lined = [f"{head:>{before}}{point + tail:<{after}}" for head, point, tail in parts]
    width = max([before + after] + [len(cell) for cell in cells])
    shown = []
    for cell, (head, point, tail), line in zip(cells, parts, lined, strict=True):
        is_gap = not (head or point or tail)
        text = (
            f"{MISSING:>{before}}{'':<{after}}"
            if cell == MISSING and before
            else cell
            if is_gap
            else line
        )
        shown.append(text.rjust(width))
    return shown


def _line(cells: Sequence[str], widths: Sequence[int], columns: Sequence[Column]) -> str:
    place = {"left": str.ljust, "right": str.rjust, "center": str.center, "decimal": str.rjust}
    return "  ".join(
        place[column.align](cell, width)
        for cell, width, column in zip(cells, widths, columns, strict=True)
    )


def _breakable(text: str) -> str:
    """Return the text escaped; a long one may break after underscores."""
    return (
        html.escape(text).replace("_", "_<wbr>") if len(text) > SHORT_HEADER else html.escape(text)
    )


def _html_class(column: Column) -> str:
    return (
        ""
        if column.align == "left"
        else f' class="{"number" if column.align in ("right", "decimal") else "center"}"'
    )


def _html_cell(column: Column, cell: Cell) -> str:
    value = cell.value if isinstance(cell, Shown) else cell
    is_number = isinstance(value, int | float) and math.isfinite(value)
    full = f' data-value="{value!r}"' if is_number else ""
    return f"<td{_html_class(column)}{full}>{html.escape(column.shown(cell))}</td>"


def _csv_cell(cell: Cell) -> str:
    value = cell.value if isinstance(cell, Shown) else cell
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return repr(value) if isinstance(value, float) else str(value)
