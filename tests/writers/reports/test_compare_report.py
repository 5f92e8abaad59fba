"""Page of a comparison with CAD: its order, and its width on a narrow screen."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from chromium import chromium

from asbuilt.identification import determination
from asbuilt.validation import attribute, compare
from asbuilt.writers import CadVerdict, write_comparison

sys.path.insert(0, str(Path(__file__).parents[2] / "validation"))
from virtual_causes import identified


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    result = identified("kuka-iiwa7-r800", "pf")
    verdict = CadVerdict(compare(result), attribute(result), determination(result))
    return write_comparison(tmp_path_factory.mktemp("comparison"), result, verdict)


@pytest.mark.parametrize("width", [1300, 900])
@pytest.mark.study
def test_no_table_is_cut_off(files: dict[str, Path], width: int, tmp_path: Path) -> None:
    browser = chromium(tmp_path, f"disable-gpu window-size={width},1000")
    browser.get(files["report"].as_uri())
    run = browser.execute_script
    beyond = run(
        "return [...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth"
        " + 1).length"
    )
    shown = run("return document.querySelectorAll('.scroll table').length")
    browser.quit()
    assert shown == 3
    assert beyond == 0


def test_page_and_text_begin_with_what_matters(files: dict[str, Path]) -> None:
    page, text = (
        files["report"].read_text(encoding="utf-8"),
        files["text"].read_text(encoding="utf-8"),
    )
    order = (
        "base parameters contradict CAD",
        "Causes of the CAD error",
        "Shares of the effects",
        "first moment along z, links 4 to 7",
    )
    places = [page.index(words) for words in order]
    assert places == sorted(places)
    assert text.index("Causes of the torque error of CAD") < text.index("Base parameters")
    assert "causes of the torque error of CAD (RMS" not in text


def test_page_without_evidence_has_the_torque_table(example: Any) -> None:
    verdict = CadVerdict(compare(example.result), None, determination(example.result))
    page = verdict.as_html(example.result)
    assert 'id="joint-table"' in page
    assert "<img src=x" not in page
    said = verdict.as_text()
    for text in (page, " ".join(said.split())):
        assert "Causes of the CAD error, and the torque of differences, are unknown" in text
