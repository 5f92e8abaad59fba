import csv
import io
from decimal import ROUND_HALF_EVEN, Decimal
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st

from asbuilt.tables import (
    Column,
    Shown,
    Table,
    format_deviation,
    format_percent,
    format_plus_minus,
    round_significant,
    round_with_error,
    shorten_text,
    stack_tables,
)

GOLDEN = """\
Parameters
id  parameter      as built  std err  CAD vs built
                     kg m^2   kg m^2
--------------------------------------------------
 4  Iyy1 + Izz2      0.0310   0.0041    +1.8 sigma
 8  mz2 - my3 ...   -6.2048   0.0023       DIFFERS
12  x              123       21                  -
13  y                -        -                  -
[1] Invented.
"""


def sample() -> Table:
    rows = []
    for number, name, value, error, sigmas in [
        (4, "Iyy1 + Izz2", 0.0309871, 0.00412, 1.83),
        (8, "mz2 - my3 + 0.4 m3 + 0.4 m4", -6.20484, 0.00231, -57.0),
        (12, "x", 123.0, 21.0, None),
        (13, "y", float("nan"), float("nan"), None),
    ]:
        shown, uncertainty = round_with_error(value, error)
        rows.append(
            (number, name, Shown(value, shown), Shown(error, uncertainty), format_deviation(sigmas))
        )
    heads = (
        Column("id", align="right"),
        Column("parameter", width=15),
        Column("as built", "kg m^2", "decimal"),
        Column("std err", "kg m^2", "decimal"),
        Column("CAD vs built", align="right"),
    )
    return Table(heads, tuple(rows), title="Parameters", notes=("Invented.",))


def test_text_is_golden() -> None:
    assert sample().as_text() == GOLDEN
    assert str(sample()) == GOLDEN
    assert stack_tables([sample(), sample()]) == GOLDEN + "\n" + GOLDEN


def wide() -> Table:
    heads = (
        Column("joint"),
        Column("sentence"),
        Column("value", "N m", "decimal"),
        Column("rarely read", detail=True),
    )
    rows = tuple((f"joint_{k}", "word " * 30, 0.5 * k, "detail") for k in range(9))
    return Table(
        heads, rows, title="W", notes=("Note. " * 40,), details=("Detail.",), important=(1, 4)
    )


def test_short_text_fits_a_terminal() -> None:
    text = wide().as_text()
    assert max(len(line) for line in text.splitlines()) <= 80
    assert "joint_1" in text
    assert "joint_2" not in text
    assert "7 more rows" in text
    assert "detail" not in text.lower()


def test_full_text_has_everything() -> None:
    text = wide().as_text(full=True)
    assert text.count(("word " * 30).strip()) == 9
    assert text.count("detail") == 9
    assert "more rows" not in text
    assert "[2] Detail." in text
    assert wide().as_csv().count("detail") == 9


def test_zero_standard_errors_have_no_sign() -> None:
    assert format_deviation(-0.04) == format_deviation(0.04) == "0.0 sigma"
    assert format_deviation(-0.06) == "-0.1 sigma"


def test_decimal_points_stand_in_one_column() -> None:
    table = Table(
        (Column("v", align="decimal", style=".10g"),), ((1.5,), (-22.25,), (3,), (1e-3,), (None,))
    )
    lines = table.as_text().splitlines()[2:]
    assert {line.index(".") for line in lines if "." in line} == {3}
    assert lines[2].index("3") == 2


def test_csv_keeps_every_digit_and_whole_texts() -> None:
    rows = list(csv.reader(io.StringIO(sample().as_csv())))
    assert rows[0] == ["id", "parameter", "as built [kg m^2]", "std err [kg m^2]", "CAD vs built"]
    assert float(rows[1][2]) == 0.0309871
    assert rows[2][1] == "mz2 - my3 + 0.4 m3 + 0.4 m4"
    assert rows[4][2] == ""


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.values: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        self.seen.append(tag)
        self.values += [value or "" for name, value in attrs if name == "data-value"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_html_is_balanced_and_escaped() -> None:
    hostile = '<script>alert("x")</script>'
    table = Table(
        (Column(hostile), Column("v", hostile, "decimal")),
        ((hostile, 0.1),),
        title=hostile,
        notes=(hostile,),
    )
    parser = _Tags()
    parser.feed(table.as_html("t"))
    assert not parser.open
    assert "script" not in parser.seen
    assert parser.values == ["0.1"]


def test_control_characters_do_not_break_the_lines() -> None:
    text = Table((Column("name"),), (("a\nb\x1b[31m",),)).as_text()
    assert len(text.splitlines()) == 3
    assert "\x1b" not in text


@given(st.floats(-1e6, 1e6, allow_nan=False), st.floats(1e-12, 1e6))
def test_rounding_agrees_with_decimal_arithmetic(value: float, error: float) -> None:
    shown, uncertainty = (Decimal(text) for text in round_with_error(value, error))
    step = Decimal(1).scaleb(Decimal(f"{error:.1e}").adjusted() - 1)
    expected = (
        Decimal(error).quantize(step, ROUND_HALF_EVEN)
        if step < 1
        else (Decimal(error) / step).quantize(Decimal(1)) * step
    )
    assert (
        abs(uncertainty - expected) <= step * Decimal("0.001")
        or abs(abs(uncertainty - Decimal(error)) - step / 2) < step / 1000
    )
    assert abs(shown - Decimal(value)) <= step * Decimal("0.5001")
    assert "-0." not in f"{shown}" or value < 0


def test_rounding_at_the_edges() -> None:
    assert round_with_error(1.0, 0.0996) == ("1.00", "0.10")
    assert round_with_error(123456.0, 1234.0) == ("123500", "1200")
    assert round_with_error(-1e-9, 0.01) == ("0.000", "0.010")
    assert round_with_error(1.0, None) == ("1", "-")
    assert round_with_error(1.0, 0.0) == ("1", "0")
    assert round_with_error(float("nan"), None) == ("-", "-")
    assert format_plus_minus(2.0, float("inf")) == "2"
    assert format_percent(1.0, None) == "-"
    assert round_significant(9.999) == "10.0"
    assert round_significant(float("inf")) == "-"
    assert shorten_text("abcdefghij", 6) == "abc..."
    assert shorten_text("Ixx5 - Iyy5 + Izz6 - 0.1414*my6 + m", 34) == "Ixx5 - Iyy5 + Izz6 ..."


@given(st.text(alphabet="ab +-", max_size=30), st.integers(1, 30))
def test_shortened_texts_fit(text: str, width: int) -> None:
    cut = shorten_text(text, width)
    assert cut == text if len(text) <= width else len(cut) <= max(width, 3)


def test_row_of_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="row 1 of table 'T' has 2 cells for 1 columns"):
        Table((Column("a"),), (("x", "y"),), title="T")
