"""The whole story in one go, and what it leaves behind."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from asbuilt import run_demo
from asbuilt.apps.paper.demo import Demo, demo_document, describe_demo
from asbuilt.codec import format_json
from asbuilt.description import load_robot
from command_line import documented_fields
from shown_numbers import missing

README = Path(__file__).resolve().parents[3] / "README.md"
TOLERANCE = 0.5
"""Of the numbers that README.md shows: rounding alone sends the search to another good optimum."""

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    return run_demo(tmp_path_factory.mktemp("demo"))


def test_designed_motion_keeps_the_limits_and_determines_every_parameter(story: Demo) -> None:
    assert story.design.limits.is_respected
    assert story.study.result.rank == story.study.result.n_base == 64


def test_robot_as_built_predicts_another_motion_far_better_than_cad(story: Demo) -> None:
    held = story.study.validations[0]
    assert held.metrics_as_built.relative_error < 0.25 * held.metrics_cad.relative_error


def test_it_finds_the_truth(story: Demo) -> None:
    assert story.recovery is not None
    assert story.recovery.within(3.0) > 0.9
    assert story.recovery.torque_error < 0.02 * story.recovery.cad_error


def test_the_gripper_is_named_among_the_causes(story: Demo) -> None:
    """With the interval of its mass: the log does not tell it from the masses of the links."""
    named = [
        re.search(r"payload \((\S+) to (\S+)", sentence) for sentence in story.causes.sentences
    ]
    assert any(found and float(found[1]) <= 1.2 <= float(found[2]) for found in named)


def test_files_are_there_and_load_again(story: Demo) -> None:
    for kind, path in story.files.items():
        assert Path(path).stat().st_size > 0, kind
    assert load_robot(str(story.files["robot"])).n_joints == 7
    assert load_robot(str(story.files["urdf"])).n_joints == 7


def test_it_ends_in_one_screen_and_one_document(story: Demo) -> None:
    screen = describe_demo(story)
    assert str(story.files["report"]) in screen
    assert len(screen.splitlines()) <= 40
    folder = str(story.files["report"].parent)
    assert all(len(line) <= 80 or folder in line for line in screen.splitlines())
    assert f"{len(story.files)} in {folder}" in screen
    document = json.loads(format_json(demo_document(story)))
    assert set(document) == documented_fields()["demo"][0]


def test_the_readme_shows_this_screen(story: Demo) -> None:
    block = next(
        each
        for each in re.findall(r"^```\n(.*?)^```", README.read_text(), re.DOTALL | re.MULTILINE)
        if each.startswith("kuka-iiwa7-r800 with")
    )
    shown, printed = (
        # How long the search takes is the machine's, which consistent fit is chosen the motion's.
        re.sub(
            r"by (entropic|consistent) from \d+ samples",
            "by a fit from so many samples",
            re.sub(r"motion in \d+ s", "motion in so many s", text),
        )
        for text in (block.partition("\n...")[0], describe_demo(story))
    )
    lacking = missing(shown, printed, TOLERANCE)
    assert not lacking, f"the README shows\n{lacking}\nand the demo prints\n{printed}"
