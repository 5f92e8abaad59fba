"""The tutorial's commands run in order and print what the page shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from command_line import call
from shown_numbers import missing

pytestmark = pytest.mark.apps(
    *("estimators", "fleet", "masses", "page", "paper", "programs", "simulators", "watch")
)
"""The documentation and the examples are of the whole distribution."""

TOLERANCE = 0.25
"""Of the numbers shown: the search for a motion ends at another one with other libraries."""
PAGE = Path(__file__).resolve().parents[1] / "docs" / "tutorial.md"


def commands() -> list[tuple[str, list[str]]]:
    """Return each command of the page with the lines shown below it."""
    found: list[tuple[str, list[str]]] = []
    for block in re.findall(r"^```console\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE):
        for line in block.splitlines():
            if line.startswith("$ "):
                found.append((line[2:], []))
            else:
                found[-1][1].append(line)
    return found


@pytest.mark.study
def test_the_tutorial_prints_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    assert commands()
    for line, expected in commands():
        program, *arguments = shlex.split(line)
        assert program == "asbuilt"
        status, out, err = call(capsys, *arguments)
        assert status == 0, f"{line}\n{err}"
        lacking = missing("\n".join(expected), out, TOLERANCE)
        assert not lacking, f"{line} prints no longer:\n{lacking}\nbut\n{out}"
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE):
        exec(compile(block, PAGE.name, "exec"), {})
