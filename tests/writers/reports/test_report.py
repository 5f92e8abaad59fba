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

from asbuilt.validation import attribute, validate_samples
from asbuilt.workflow import Study
from asbuilt.writers import report_html, write_report
from asbuilt.writers.reports.cards import make_study_cards
from asbuilt.writers.reports.sections.parameters import place_interval
from command_line import call_elsewhere

sys.path.append(str(Path(__file__).parents[2] / "validation"))
from virtual_causes import identified

VOID = {"meta", "link", "br", "img", "input", "hr", "line", "circle", "path"}
SECTION = """
from asbuilt.writers.reports.page import paragraph_markup
from asbuilt.writers.reports.report import Section, sections

def parts(report):
    return [paragraph_markup(f"{report.study.result.robot}: <b>escaped</b>")]

sections.register("outside", Section("From outside", 65, parts))
"""


@pytest.fixture(scope="module")
def page(example: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    study = Study(
        example.result,
        example.result.findings,
        validations=(validate_samples(example.result, example.held_out),),
        training=(validate_samples(example.result, example.train),),
    )
    command = ["asbuilt", "identify", "robot <b>.toml", "train.csv", "--holdout", "last:0.3"]
    return write_report(tmp_path_factory.mktemp("report") / "report.html", study, command=command)


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
    assert page.stat().st_size < 1e6


def test_hostile_names_stay_text(page: Path) -> None:
    parser = parsed(page)
    assert "img" not in parser.tags
    assert parser.handlers == []
    assert "<b>.toml" not in page.read_text(encoding="utf-8")


def test_a_result_without_held_out_data_says_so(example: Any) -> None:
    result = replace(
        example.result, validation=(), cad=replace(example.result.cad, source="train.csv")
    )
    text = report_html(Study(result, result.findings))
    assert "UNTESTED: fits its log to " in text
    assert 'id="torque-plot"' not in text


def test_verdict_shouts_when_the_fit_is_worse_than_the_design(example: Any) -> None:
    result = replace(
        example.result,
        validation=(example.result.cad,),
        cad=example.result.validation[0],
        physically_consistent=True,
    )
    study = Study(result, ())
    cards = make_study_cards(study)
    assert cards[0].mood == "bad"
    assert study.verdict.text.startswith("DO NOT USE: CAD is better")
    assert cards[1].mood == "good"
    study = Study(example.result, ())
    good = make_study_cards(study)
    assert study.verdict.text.endswith(
        "; DO NOT USE as bodies: physically inconsistent, so that no simulator takes it."
    )
    assert good[1].mood == "bad"


def test_cards_agree_with_each_other(example: Any) -> None:
    """Parameters counted as determined are those with an error below half their value."""
    study = Study(example.result, ())
    size = [
        max(abs(p.estimate), abs(p.cad) if p.cad == p.cad else 0.0)
        for p in example.result.parameters
    ]
    expected = sum(
        p.determined and p.std_error <= 0.5 * each
        for p, each in zip(example.result.parameters, size, strict=True)
    )
    card = make_study_cards(study)[-2]
    assert card.figure == f"{expected} of {example.result.n_base}"


@pytest.mark.parametrize("cad", [None, 1.0, -3.0, 5e-4])
def test_intervals_are_drawn_to_scale(cad: float | None) -> None:
    drawn = place_interval(1.2, 0.3, cad)
    ticks = [(x, float(text)) for x, text in drawn["ticks"]]
    assert 2 <= len(ticks) <= 4
    (x0, v0), (x1, v1) = ticks[0], ticks[-1]
    slope = (x1 - x0) / (v1 - v0)
    known = [(drawn["x"], 1.2), (drawn["low"], 0.9), (drawn["high"], 1.5)]
    known += [] if cad is None else [(drawn["x_cad"], cad)]
    for place, value in known:
        assert abs(x0 + slope * (value - v0) - place) < 0.5
        assert 0.0 <= place <= 170.0


@pytest.mark.study
def test_a_section_of_another_distribution_is_in_the_page(tmp_path: Path) -> None:
    site = tmp_path / "site"
    (site / "outside-1.0.dist-info").mkdir(parents=True)
    (site / "outside_section.py").write_text(SECTION)
    (site / "outside-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n"
    )
    (site / "outside-1.0.dist-info" / "entry_points.txt").write_text(
        "[asbuilt.report_sections]\noutside = outside_section\n"
    )
    recorded = "simulate two-link --engine inverse-dynamics --duration 6 --rate 100 --out log.csv"
    call_elsewhere(tmp_path, site, recorded, "identify two-link log.csv --method wls --out study")
    page = (tmp_path / "study" / "report.html").read_text(encoding="utf-8")
    assert "<h2>From outside</h2>" in page
    assert "two-link: &lt;b&gt;escaped&lt;/b&gt;" in page
    assert page.index('id="parameters"') < page.index('id="outside"')
    assert page.index('id="outside"') < page.index('id="provenance"')


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
        browser.execute_script(f"return document.querySelectorAll('#{identifier} g .trace').length")
    )


def test_page_works_in_a_browser(browser: Any, page: Path, example: Any) -> None:
    browser.get(page.as_uri())
    run = browser.execute_script
    assert run("return document.documentElement.dataset.ready") == "true"
    assert drawn(browser, "torque-plot") == 5
    assert drawn(browser, "singular-plot") == 2
    assert drawn(browser, "correlation-plot") == 2
    assert run("return document.querySelectorAll('#histogram-plot .bars rect').length") > 10

    names = example.model.joint_names
    assert run("return document.getElementById('torque-title').textContent") == names[0]
    run("document.querySelectorAll('#joints button')[1].click()")
    assert run("return document.getElementById('torque-title').textContent") == names[1]
    curve = "return document.querySelector('#torque-plot g .trace').getAttribute('d')"
    before = run(curve)
    run(
        "const s = document.getElementById('recording'); s.value = '1'; s.dispatchEvent(new"
        " Event('change'))"
    )
    after = run(curve)
    assert after != before
    assert after.count("M") == len(example.train.segments)
    assert "NaN" not in after
    zoom = (
        "const svg = document.querySelector('#torque-plot svg'), box ="
        " svg.getBoundingClientRect(); for (const [name, part] of [['down', 0.3], ['move', 0.5],"
        " ['up', 0.5]]) svg.dispatchEvent(new PointerEvent('pointer' + name, {clientX: box.left +"
        " part * box.width, clientY: box.top + 50}))"
    )
    run(zoom)
    assert run(curve) != after
    run("document.querySelector('#torque-plot svg').dispatchEvent(new MouseEvent('dblclick'))")
    assert run(curve) == after

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
    result = identified("kuka-iiwa7-r800", "pf")
    study = Study(result, result.findings, attribution=attribute(result))
    page = write_report(tmp_path / "report.html", study)
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
