"""Numbers of the pages stand in the files of the benchmark's run, and pages are what it writes."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

HOUSE = Path(__file__).resolve().parents[2]
sys.path.append(str(HOUSE / "benchmarks" / "open"))

pytest.importorskip("matplotlib")

from page import PAGE, page_text  # noqa: E402
from pages import DOCS, page_texts  # noqa: E402
from shown import (  # noqa: E402
    PAGES,
    PRINTS,
    Quotes,
    masked,
    quantities,
    renewed_block,
    renewed_page,
    renewed_sentence,
    strays,
)

QUOTES = Quotes.read()
WRITTEN = [HOUSE / page for page in PAGES]
NOTEBOOKS = sorted((HOUSE / "docs" / "notebooks").glob("*.ipynb"))


def prose(path: Path) -> str:
    """Return a page, or the text cells of a notebook."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    cells = [each for each in json.loads(text)["cells"] if each["cell_type"] == "markdown"]
    return "\n".join("".join(each["source"]) for each in cells)


@pytest.mark.parametrize("path", [*WRITTEN, *NOTEBOOKS, PAGE], ids=lambda path: path.name)
def test_no_page_says_a_number_that_stands_nowhere(path: Path) -> None:
    assert strays(prose(path), QUOTES.constants) == []


def test_a_number_that_stands_nowhere_is_found() -> None:
    assert strays("a torque error of 77.77 % and 123.4 to 567.8 kg", {}) == [
        *("77.77 %", "567.8 kg", "123.4 kg")
    ]


@pytest.mark.parametrize("page", PAGES)
def test_pages_have_the_numbers_of_the_run(page: str) -> None:
    text = (HOUSE / page).read_text(encoding="utf-8")
    renewed, lacking = renewed_page(text, QUOTES, page)
    assert lacking == []
    assert renewed == text, "old: python benchmarks/open/shown.py"


def test_the_pages_of_the_benchmark_are_those_of_its_rows() -> None:
    assert PAGE.read_text(encoding="utf-8") == page_text(), "old: python benchmarks/open/shown.py"
    texts = page_texts()
    kept = {path.name: path.read_text(encoding="utf-8") for path in DOCS.iterdir()}
    assert kept == texts, "old: python benchmarks/open/shown.py"


def test_every_print_is_of_a_command_that_is_named() -> None:
    named = {f"{name}.txt" for name in QUOTES.commands}
    named |= {each["truth"] for each in QUOTES.commands.values() if "truth" in each}
    assert {path.name for path in PRINTS.iterdir()} == named
    assert not [
        path.name
        for path in PRINTS.iterdir()
        if re.search(r"/(?:tmp|work|root)/", path.read_text())
    ]


def test_numbers_of_a_block_are_renewed_and_other_words_are_named() -> None:
    shown = ["RMS   A1", "---", "CAD  1.5", "...", "gone 3.0"]
    printed = ["first", "RMS   A1", "------", "CAD  1.234", "as built 0.1"]
    assert renewed_block(shown, printed) == (
        ["RMS   A1", "------", "CAD  1.234", "...", "gone 3.0"],
        ["gone 3.0"],
    )
    assert masked("CAD -1.5e-3  x2") == "CAD # x2"


def test_a_sentence_takes_the_number_of_its_source() -> None:
    row = {"page": "x", "text": "off by {a} % of", "from": {"a": "med7/cad/error"}}
    text, found = renewed_sentence("It is off by\n1.0 % of it.", row)
    assert found
    assert re.fullmatch(r"It is off by\n\d+\.\d % of it\.", text)
    assert renewed_sentence("Nothing.", row) == ("Nothing.", False)


def test_quantities_are_numbers_of_percent_and_kilograms() -> None:
    text = "5.7 % and 1.2 to 3.4 kg, 20 s, 3 m, x = 2, 1.9 %."
    assert sorted(quantities(text)) == ["1.2 kg", "1.9 %", "3.4 kg", "5.7 %"]
