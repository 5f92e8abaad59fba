"""The page of two results.

What it says first, its numbers, and that nothing of it is cut off on a narrow screen.
"""

from __future__ import annotations

import base64
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import chromium
from matplotlib.patches import Rectangle

from asbuilt.description import load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.validation import Drift, compare_results
from asbuilt.workflow import ControllerComparison, ControllerOptions, compare_controller
from asbuilt.writers import write_drift
from asbuilt.writers.figures.comparison_figures import draw_drift
from asbuilt.writers.reports.compare_files import render_drift

sys.path.insert(0, str(Path(__file__).parents[2] / "validation"))
from virtual_causes import identified, recorded

ARM = "kuka-iiwa7-r800"
WORN = (1.0, 2.0, 1.0, 2.0, 1.4, 3.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0)


@pytest.fixture(scope="module")
def drift() -> Drift:
    return compare_results(
        identified(ARM, "f"),
        identified(ARM, "f", seed=2, friction=WORN),
        labels=("january.json", "<b>july</b>.json"),
    )


@pytest.fixture(scope="module")
def controller() -> ControllerComparison:
    recording = recorded(ARM, "pf")
    qd = np.gradient(recording.q, recording.t, axis=0, edge_order=2)
    qdd = np.gradient(qd, recording.t, axis=0, edge_order=2)
    external = recording.tau - inverse_dynamics(load_robot(ARM), recording.q, qd, qdd)
    return compare_controller(
        identified(ARM, "pf"),
        replace(recording, extra={"tau_ext": external}),
        options=ControllerOptions(holdout="blocks:2s:3"),
    )


@pytest.mark.study
@pytest.mark.parametrize("width", [900])
def test_no_table_is_cut_off(
    drift: Drift, controller: ControllerComparison, width: int, tmp_path: Path
) -> None:
    browser = chromium(tmp_path / "profile", f"disable-gpu window-size={width},1000", browser="ALL")
    tables = []
    for name, compared in (("drift", drift), ("controller", controller)):
        browser.get(write_drift(tmp_path / name, compared)["report"].as_uri())
        run = browser.execute_script
        tables.append(run("return document.querySelectorAll('.scroll table').length"))
        assert (
            run(
                "return [...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth >"
                " e.clientWidth + 1).length"
            )
            == 0
        )
        assert run(
            "return document.documentElement.scrollWidth <= document.documentElement.clientWidth"
        )
        assert run(
            "return [...document.images].every(image => image.complete && image.naturalWidth > 100)"
        )
    said = browser.get_log("browser")
    browser.quit()
    assert tables == [3, 4]
    assert said == []


def test_sentences_come_first_then_torque_then_parameters(drift: Drift) -> None:
    page = render_drift(drift)
    order = (
        "parameters changed (false",
        "The torque of the same motion changed: A3 by",
        "A3: ",
        'id="joints-by-torque"',
        'id="changed"',
        'id="others"',
    )
    places = [page.index(words) for words in order]
    assert places == sorted(places)
    assert "<b>july" not in page
    assert "&lt;b&gt;july&lt;/b&gt;.json against january.json" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page


def test_every_parameter_stands_once_where_it_belongs(drift: Drift) -> None:
    page = render_drift(drift)
    ids = {
        name: [
            int(i)
            for i in re.findall(
                r'<tr><td class="number" data-value="(\d+)">',
                page.split(f'id="{name}"')[1].split("</table>")[0],
            )
        ]
        for name in ("changed", "others")
    }
    assert sorted(ids["changed"]) == sorted(
        change.id for change in drift.parameters if change.changed
    )
    assert sorted(ids["changed"] + ids["others"]) == sorted(
        change.id for change in drift.parameters
    )
    assert "DIFFERS" not in page


def test_bars_are_as_long_as_the_torques(drift: Drift) -> None:
    figure = draw_drift(drift)
    (axis,) = figure.axes
    bars = [
        patch for patch in axis.patches if isinstance(patch, Rectangle) and patch.get_width() > 0
    ]
    lengths: list[list[float]] = [[] for _ in drift.joints]
    for bar in bars:
        lengths[round(bar.get_y() + bar.get_height() / 2)].append(bar.get_width())
    np.testing.assert_allclose(lengths, [[joint.torque, joint.by_chance] for joint in drift.joints])


def test_page_of_the_controller_says_whose_model_is_better(
    controller: ControllerComparison,
) -> None:
    page = render_drift(controller)
    places = [
        page.index(words)
        for words in (
            "The robot as built predicts torque better",
            'id="torque-table"',
            'id="joints-by-torque"',
        )
    ]
    assert places == sorted(places)
    assert "changed" not in re.sub(r"<[^>]*>", "", page.split("</style>")[1]).lower()
    assert "(controller) against" in page


def test_unchanged_robot_and_results_without_evidence(example: Any) -> None:
    result = replace(example.result, cause_data=None)
    same = compare_results(result, result)
    page = render_drift(same)
    assert "No parameter changed significantly." in page
    assert 'id="changed"' not in page
    assert "<img" not in page
    assert "onerror=alert(1)>" not in page
    assert f"0 of {sum(change.sigmas is not None for change in same.parameters)}" in page


def test_figure_in_the_page_is_the_figure(drift: Drift) -> None:
    (address,) = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', render_drift(drift))
    assert base64.b64decode(address).lstrip().startswith(b"<?xml")
