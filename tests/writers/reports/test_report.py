from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from chromium import chromium

from asbuilt.validation.comparison.comparison import compare
from asbuilt.validation.prediction import validate_samples
from asbuilt.writers.reports.report import report_html, write_report
from asbuilt.writers.reports.report_verdict import verdict

sys.path.append(str(Path(__file__).parents[2] / "validation"))
from virtual_causes import identified

VOID = {"meta", "link", "br", "img", "input", "hr", "line", "circle"}


@pytest.fixture(scope="module")
def page(example: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    held_out, fitted = (
        validate_samples(example.result, example.held_out),
        validate_samples(example.result, example.train),
    )
    command = ["asbuilt", "identify", "robot <b>.toml", "train.csv", "--holdout", "last:0.3"]
    return write_report(
        tmp_path_factory.mktemp("report") / "report.html",
        example.result,
        [held_out],
        fitted=[fitted],
        command=command,
    )


class Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.tags: set[str] = set()
        self.handlers: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "srcset", "action"):
                self.references.append(value or "")
            if name.startswith("on"):
                self.handlers.append(name)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def parsed(path: Path) -> Page:
    parser = Page()
    parser.feed(path.read_text(encoding="utf-8"))
    return parser


def test_page_is_balanced_and_refers_to_nothing_outside(page: Path) -> None:
    parser = parsed(page)
    assert parser.open == []
    assert len(parser.ids) == len(set(parser.ids))
    assert all(reference.startswith(("#", "data:,")) for reference in parser.references)
    assert {reference[1:] for reference in parser.references if reference.startswith("#")} <= set(
        parser.ids
    )
    assert page.stat().st_size < 8e6


def test_hostile_names_stay_text(page: Path) -> None:
    parser = parsed(page)
    assert "img" not in parser.tags
    assert parser.handlers == []
    assert "<b>.toml" not in page.read_text(encoding="utf-8")


def test_a_result_without_held_out_data_says_so(example: Any) -> None:
    result = replace(
        example.result, validation=(), cad=replace(example.result.cad, source="train.csv")
    )
    text = report_html(result)
    assert "No recording was held out" in text
    assert 'id="torque-plot"' not in text


def test_verdict_shouts_when_the_fit_is_worse_than_the_design(example: Any) -> None:
    result = replace(
        example.result,
        validation=(example.result.cad,),
        cad=example.result.validation[0],
        physically_consistent=True,
    )
    findings = verdict(result, compare(result))
    assert findings[0].mood == "bad"
    assert "WORSE" in findings[0].sentence
    assert findings[1].mood == "good"
    good = verdict(example.result, compare(example.result))
    assert good[0].mood == "good"
    assert "times smaller" in good[0].sentence
    assert good[1].mood == "bad"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    window = chromium(
        tmp_path_factory.mktemp("profile"),
        "disable-gpu window-size=1280,1000",
        browser="ALL",
        performance="ALL",
    )
    yield window
    window.quit()


def requests(browser: Any) -> list[str]:
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    sent = [
        m["params"]["request"]["url"]
        for m in messages
        if m["method"] == "Network.requestWillBeSent"
        and m["params"]["documentURL"] == browser.current_url
    ]
    assert browser.current_url in sent
    return [url for url in sent if not re.match(r"(file|data|blob):", url)]


def drawn(browser: Any, identifier: str) -> int:
    return int(
        browser.execute_script(
            f"return document.querySelectorAll('#{identifier} .scatterlayer .trace').length"
        )
    )


def test_page_works_in_a_browser(browser: Any, page: Path, example: Any) -> None:
    browser.get(page.as_uri())
    run = browser.execute_script
    assert run("return document.documentElement.dataset.ready") == "true"
    assert drawn(browser, "torque-plot") == 5
    assert drawn(browser, "singular-plot") == 2
    assert drawn(browser, "correlation-plot") == 3
    assert run("return document.querySelectorAll('#histogram-plot .bars .point').length") > 10

    names = example.model.joint_names
    assert run("return document.getElementById('torque-title').textContent") == names[0]
    run("document.querySelectorAll('#joints button')[1].click()")
    assert run("return document.getElementById('torque-title').textContent") == names[1]
    before = run("return document.getElementById('torque-plot').data[0].y[5]")
    run(
        "const s = document.getElementById('recording'); s.value = '1'; s.dispatchEvent(new"
        " Event('change'))"
    )
    assert run("return document.getElementById('torque-plot').data[0].y[5]") != before
    assert run("return document.getElementById('torque-plot').data[0].y.includes(null)")

    titles = run(
        "return Array.from(document.querySelectorAll('.modebar-btn')).map(b => b.dataset.title)"
    )
    assert titles
    assert not any("hare" in title or "loud" in title for title in titles)

    visible = (
        "return Array.from(document.querySelectorAll('#parameter-table tbody tr')).filter(r =>"
        " !r.hidden).map(r => r.cells[0].textContent)"
    )
    assert len(run(visible)) == example.result.n_base
    run(
        "const f = document.getElementById('find'); f.value = 'Fv'; f.dispatchEvent(new"
        " Event('input'))"
    )
    assert [int(number) for number in run(visible)] == [
        p.id for p in example.result.parameters if "Fv" in p.expression
    ]
    run(
        "const f = document.getElementById('find'); f.value = ''; f.dispatchEvent(new"
        " Event('input'))"
    )
    run("document.querySelectorAll('#parameter-table th button')[4].click()")
    assert [int(number) for number in run(visible)] == [
        p.id for p in sorted(example.result.parameters, key=lambda p: p.estimate)
    ]

    assert (
        run(
            "return window.alert.toString().includes('native') &&"
            " document.querySelectorAll('img').length"
        )
        == 0
    )
    assert [
        entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")
    ] == []
    assert requests(browser) == []
    assert (
        run(
            "return performance.getEntriesByType('resource').filter(e =>"
            " !e.name.startsWith('data:')).length"
        )
        == 0
    )


def test_nothing_overflows_a_phone(browser: Any, page: Path) -> None:
    browser.set_window_size(500, 900)
    browser.get(page.as_uri())
    run = browser.execute_script
    assert run(
        "return document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    )


@pytest.mark.parametrize("width", [1300, 900])
def test_no_table_is_cut_off(browser: Any, width: int, tmp_path: Path) -> None:
    """Seven joints with long expressions of parameters, causes and all, at the width of half a
    screen too.
    """
    page = write_report(tmp_path / "report.html", identified("kuka-iiwa7-r800", "pf"), [])
    browser.set_window_size(width, 1000)
    browser.get(page.as_uri())
    run = browser.execute_script
    assert run("return document.querySelectorAll('.scroll table').length") >= 3
    assert (
        run(
            "return [...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth >"
            " e.clientWidth + 1).map(e => e.innerText.slice(0, 60))"
        )
        == []
    )
