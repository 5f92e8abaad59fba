"""The tutorial's commands run in order and print what the page shows, numbers aside."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from command_line import call

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


def masked(text: str) -> list[str]:
    """Return the words of a text, numbers replaced by `#` and rules removed."""
    text = re.sub(r"-{3,}", " ", text)
    return re.sub(r"(?<![\w.])[-+]?\d[\d.]*(e[-+]?\d+)?", "#", text).split()


def shown(expected: list[str], words: list[str]) -> str:
    """Return the first part, between ellipses, that the output lacks, or an empty string."""
    place = 0
    for part in re.split(r"\.\.\.$", "\n".join(expected), flags=re.MULTILINE):
        wanted = masked(part)
        fits = (k for k in range(place, len(words) + 1) if words[k : k + len(wanted)] == wanted)
        start = next(fits, None)
        if start is None:
            return part
        place = start + len(wanted)
    return ""


@pytest.mark.study
def test_the_tutorial_prints_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    assert commands()
    for line, expected in commands():
        program, *arguments = shlex.split(line.replace("--time-limit 60", "--time-limit 5"))
        assert program == "asbuilt"
        status, out, err = call(capsys, *arguments)
        assert status == 0, f"{line}\n{err}"
        missing = shown(expected, masked(out))
        assert not missing, f"{line} prints no longer:\n{missing}\nbut\n{out}"
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE):
        exec(compile(block, PAGE.name, "exec"), {})
