"""Schemas of the files that people write: an independent validator judges files by them."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from asbuilt.description import robots
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.errors import DescriptionError, RecordingError, UsageError
from asbuilt.experiment import read_sheet
from asbuilt.writers import json_schema
from asbuilt.writers.schemas import SCHEMAS

PAGES = Path(__file__).resolve().parents[2] / "docs" / "reference"
BUNDLED = sorted(Path(next(iter(robots.__path__))).glob("*.toml"))


def validator(kind: str) -> Any:
    jsonschema = pytest.importorskip("jsonschema")
    return jsonschema.Draft202012Validator(json_schema(kind))


def shown(page: str) -> list[dict[str, Any]]:
    """Return the TOML that a page of the reference shows."""
    text = (PAGES / page).read_text(encoding="utf-8")
    return [
        json.loads(json.dumps(tomllib.loads(block), default=str))
        for block in re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    ]


@pytest.mark.parametrize("kind", SCHEMAS)
def test_a_schema_is_one_and_is_json(kind: str) -> None:
    schema = json_schema(kind)
    json.dumps(schema, allow_nan=False)
    validator(kind).check_schema(schema)


@pytest.mark.parametrize("path", BUNDLED, ids=lambda path: path.stem)
def test_bundled_robots_are_valid(path: Path) -> None:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    assert [each.message for each in validator("robot").iter_errors(content)] == []


def test_files_that_the_reference_shows_are_valid() -> None:
    whole = [each for each in shown("robot-file.md") if "links" in each and "name" in each]
    sheets = shown("recordings.md")
    assert whole
    assert sheets
    for kind, contents in (("robot", whole), ("sheet", sheets)):
        for content in contents:
            assert [each.message for each in validator(kind).iter_errors(content)] == []


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("sheet", {"columns": {"position": "2-7", "torque": [8, "tau_2"]}, "lock": ["jaw"]}),
        ("sheet", {"lock": {"jaw": 0.1}, "joint_units": {"jaw": "deg"}}),
        ("robot", {"name": "a", "links": [{"name": "b", "dh": {"d": 1.0}}]}),
    ],
)
def test_short_forms_are_valid(kind: str, content: dict[str, Any]) -> None:
    assert validator(kind).is_valid(content)


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("sheet", {"colums": {}}),
        ("sheet", {"units": {"torqe": "N m"}}),
        ("robot", {"name": "a", "links": [{"name": "b", "dh": {"apha": 1.0}}]}),
    ],
)
def test_misspelt_fields_are_not(kind: str, content: dict[str, Any]) -> None:
    assert not validator(kind).is_valid(content)


def test_misspelt_fields_are_answered_with_the_nearest(tmp_path: Path) -> None:
    sheet = tmp_path / "log.toml"
    for text, near in (
        ("rat = 100", "rate"),
        ("[colums]\nposition = 1", "columns"),
        ('[units]\ntorqe = "N m"', "torque"),
        ("[[windows]]\nstar = 1", "start"),
        ("[joint_units]\njaw = { loged = [0, 1], position = [0, 1] }", "logged"),
    ):
        sheet.write_text(text)
        with pytest.raises(RecordingError, match=re.escape(f"did you mean {near!r}?")):
            read_sheet(sheet)
    link = '[[links]]\nname = "b"\n'
    for text, near in (
        (link + "dh = { apha = 1 }", "alpha"),
        (link + "dh = {}\ndrive = { viscos = 1 }", "viscous"),
        (link + "dh = {}\nmas = 1", "mass"),
        ("gravty = [0, 0, 1]\n" + link + "dh = {}", "gravity"),
    ):
        whole = f'name = "a"\nconvention = "standard"\n{text}'
        with pytest.raises(DescriptionError, match=re.escape(f"did you mean {near!r}?")):
            robot_from_toml(whole)


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(UsageError, match="did you mean 'robot'"):
        json_schema("robt")
