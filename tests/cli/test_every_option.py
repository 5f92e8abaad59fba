"""Every option of every command with values that make no sense: done, or one error.

The options are those that the commands have, and their ranges those of their classes.
"""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer

from asbuilt.cli.app import app
from asbuilt.cli.commands import EVERY_COMMAND, SUBCOMMANDS
from asbuilt.excitation import random_fourier
from asbuilt.workflow import identify
from asbuilt.writers import write_motion, write_recording, write_result
from command_line import call
from fleet_logs import MODEL, recording

ARGUMENTS = {
    "ROBOT": "two-link", "RESULT": "result.json", "LOG": "log.csv", "MOTION": "motion.csv",
    "LEDGER": "ledger", "OUT": "out.toml", "RESULT|ROBOT": "result.json", "LOG...": "log.csv",
    "ROBOT|RESULT": "two-link", "[MOTION]": "motion.csv", "[LOG...]": "log.csv",
    "KIND": "sheet", "[QUANTITY]...": "mass",
}  # fmt: skip
"""What stands for each argument."""
SKIPPED = {"demo", "reproduce", "fleet", "open"}
"""Commands of minutes, one that serves until it is ended, and the name of others."""
NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-308", "1e20", "9" * 400, "true",
           "0x10", "1_0", "", "1,", "\u0663", "1e")  # fmt: skip
TEXTS = (*NUMBERS, "x" * 5000, "../..", "a=b=c", ",,,", "=", "1,2,3,4,5,6,7,8,9", "\ud800", "-",
         "a=nan", "a=1e308", "9999-12-31", "0001-01-01", "{id}" * 9, "*" * 99, "a:b:c",
         "\n")  # fmt: skip
MOST, SEED = 100, 11
SLOWEST = 60.0
"""Seconds of one call, on a machine that does more than this."""


@cache
def numeric(command: str) -> list[tuple[str, float | None, float | None]]:
    """The options of a command that are numbers, with the range that its help states."""
    return [(each.opts[0], each.min, each.max) for each in options(command) if is_number(each)]


def options(command: str) -> list[Any]:
    """The options of a command that take a value."""
    return [
        each
        for each in params(command)
        if each.param_type_name == "option" and not each.is_flag and "--help" not in each.opts
    ]


@cache
def params(command: str) -> list[Any]:
    group: Any = typer.main.get_command(app)
    context = group.make_context("asbuilt", ["robots"], resilient_parsing=True)
    for name in command.split():
        group = group.get_command(context, name)
    return list(group.get_params(context))


def is_number(option: Any) -> bool:
    return option.bare_type in (int, float) or str(option.metavar) in ("HZ", "SECONDS", "N", "S")


def commands() -> list[str]:
    return [name for name in EVERY_COMMAND if name not in SKIPPED | set(SUBCOMMANDS)]


def arguments(command: str) -> list[str]:
    found = [str(each.metavar) for each in params(command) if each.param_type_name == "argument"]
    needed = {"gains": ["--loaded", "log2.csv", "--mass", "1"], "channels": ["--motor", "log2.csv"],
              "payload": [], "fleet add": ["--id", "r"], "fleet identify": ["--id", "r"],
              "fleet report": ["--out", "page"], "program": ["--format", "csv"],
              "excite": ["--time-limit", "0.1", "--duration", "2"]}  # fmt: skip
    return [ARGUMENTS[each] for each in found] + needed.get(command, [])


def cases(texts: bool) -> Iterator[tuple[str, str, str]]:
    for command in commands():
        for option in options(command):
            if is_number(option) != texts:
                for value in TEXTS if texts else NUMBERS:
                    yield command, option.opts[0], value


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    write_recording(folder / "log.csv", recording(1, seconds=4.0))
    write_recording(folder / "log2.csv", recording(2, seconds=4.0))
    write_motion(
        folder / "motion.csv", random_fourier(MODEL, rng=1, duration=2.0), MODEL.joint_names
    )
    write_result(folder / "result.json", identify(MODEL, [recording(3, seconds=6.0)]).result)
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for path in made.iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", lambda *_: True)
    monkeypatch.setattr("asbuilt.writers.pictures.viewer.Viewer.serve", lambda self: None)
    return tmp_path


def attempt(
    capsys: pytest.CaptureFixture[str], command: str, option: str, value: str
) -> tuple[int, str]:
    """Call a command with one option; what happens must be an answer or one error."""
    began = time.process_time()
    given = [*command.split(), *arguments(command), f"{option}={value}"]
    status, out, err = call(capsys, *given)
    what = f"asbuilt {' '.join(given)[:300]}: {status} {out[-300:]} {err[-600:]}"
    assert status in (0, 1, 2), what
    assert "unexpected" not in err, what
    assert "Traceback" not in err, what
    assert time.process_time() - began < SLOWEST, what
    assert len(err) < 4000, what
    assert status == 0 or (err + out).strip(), what
    return status, err


def test_every_argument_has_a_value() -> None:
    for command in commands():
        arguments(command)
    assert len(list(cases(texts=False))) > MOST


def sampled(texts: bool, most: int) -> list[tuple[str, str, str]]:
    every = list(cases(texts))
    return random.Random(SEED).sample(every, min(most, len(every)))


SENSELESS = {
    "nan",
    "inf",
    "-inf",
    "-1",
    "1e308",
    "-1e308",
    "9" * 400,
    "true",
    "0x10",
    "",
    "1,",
    "1e",
}


@pytest.mark.parametrize("command", commands())
def test_numbers_without_sense_are_refused_by_name(
    capsys: pytest.CaptureFixture[str], here: Path, command: str
) -> None:
    """Numbers that no option has: quickly, naming the option and the value."""
    for name, option, value in sampled(texts=False, most=MOST):
        if name != command or value not in SENSELESS or (option, value) == ("--delay", "-1"):
            continue
        status, err = attempt(capsys, command, option, value)
        assert status == 2, (command, option, value, err)
        assert option.lstrip("-").replace("-", " ") in err.replace("_", " ").replace("-", " "), err


@pytest.mark.study
@pytest.mark.parametrize("command", commands())
@pytest.mark.parametrize("texts", [False, True])
def test_any_value_of_any_option_is_done_or_one_error(
    capsys: pytest.CaptureFixture[str], here: Path, command: str, texts: bool
) -> None:
    for name, option, value in sampled(texts, most=1000):
        if name == command:
            attempt(capsys, command, option, value)
