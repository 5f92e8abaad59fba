"""Help, version, usage errors and the options of every command."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

import asbuilt
from asbuilt.cli.app import app
from asbuilt.cli.commands import EVERY_COMMAND, GROUPS, SUBCOMMANDS
from command_line import call

WIDTH = 80
SINGLE = [name for name in EVERY_COMMAND if name not in SUBCOMMANDS]
"""Commands that have no commands of their own."""


@pytest.fixture(autouse=True)
def _eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))


def options_of(command: str) -> set[str]:
    """Every spelling of the options of a command."""
    group: Any = typer.main.get_command(app)
    context = group.make_context("asbuilt", ["robots"], resilient_parsing=True)
    for name in command.split():
        group = group.get_command(context, name)
    params = group.get_params(context)
    return {name for param in params for name in (*param.opts, *param.secondary_opts)}


def test_help_lists_every_command_whole(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(capsys, "-h")
    assert status == 0
    assert out == call(capsys, "--help")[1]
    assert max(map(len, out.splitlines())) <= WIDTH
    assert "..." not in out.replace("[ARGS]...", "")
    for title, commands in GROUPS.items():
        assert f"\n{title}:\n" in out
        for name, entry in commands.items():
            assert any(
                line.split() == [name, *entry.summary.split()] for line in out.splitlines()
            ), name
    assert call(capsys)[:2] == (2, out)


@pytest.mark.parametrize("command", SINGLE)
def test_help_of_a_command_fits_and_ends_with_two_examples(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    status, out, _ = call(capsys, *command.split(), "-h")
    assert status == 0
    lines = out.rstrip().splitlines()
    assert max(map(len, lines)) <= WIDTH
    assert lines[-3] == "Examples:"
    assert EVERY_COMMAND[command].summary in " ".join(out.split())
    for option in ("--json", "-q, --quiet", "-v, --verbose", "-h, --help"):
        assert option in out
    assert ("-o, --out" in out) is ("--out" in options_of(command))


@pytest.mark.parametrize("command", SUBCOMMANDS)
def test_help_of_a_group_lists_its_commands(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    status, out, _ = call(capsys, command, "-h")
    assert status == 0
    assert max(map(len, out.splitlines())) <= WIDTH
    for name, entry in SUBCOMMANDS[command].items():
        assert [name, *entry.summary.split()] in [line.split() for line in out.splitlines()]
    assert call(capsys, command)[:2] == (2, out)
    assert call(capsys, command, "unknown")[0] == 2


@pytest.mark.parametrize("command", SINGLE)
def test_examples_have_options_that_exist(command: str) -> None:
    known = options_of(command)
    for example in EVERY_COMMAND[command].examples:
        given = [word.split("=")[0] for word in shlex.split(example) if word.startswith("-")]
        assert set(given) <= known


@pytest.mark.parametrize("command", [name for name in SINGLE if EVERY_COMMAND[name].call])
def test_every_command_has_its_public_function(command: str) -> None:
    assert callable(getattr(asbuilt, EVERY_COMMAND[command].call))


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys, "--version")[:2] == (0, f"asbuilt {asbuilt.__version__}\n")


@pytest.mark.parametrize(
    ("arguments", "status", "kind", "message", "hint"),
    [
        (["base"], 2, "UsageError", "Missing argument", "asbuilt base -h"),
        (["base", "scara", "--drives", "x"], 2, "UsageError", "No such option", "asbuilt base -h"),
        (["bases"], 2, "UsageError", "no command 'bases'", "did you mean base?"),
        (["base", "scara", "--drive", "viscos"], 2, "UsageError", "viscos", "viscous"),
        (["show", "kuka-iiwa7"], 1, "DescriptionError", "kuka-iiwa7", "kuka-iiwa7-r800"),
    ],
)
def test_errors_are_documents_with_json_and_one_message_without(
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    status: int,
    kind: str,
    message: str,
    hint: str,
) -> None:
    found, out, err = call(capsys, *arguments, "--json")
    error = json.loads(out)["error"]
    assert (found, err) == (status, "")
    assert error["kind"] == kind
    assert message in error["message"]
    assert hint in f"{error['message']} {error['hint']}"
    found, out, err = call(capsys, *arguments)
    assert (found, out) == (status, "")
    assert err.startswith("asbuilt: ")
    assert message in err
    assert hint in err
    assert err.count("\n") == 1


def test_quiet_prints_nothing_and_json_all_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys, "robots", "-q") == (0, "", "")
    assert json.loads(call(capsys, "robots", "-q", "--json")[1])["robots"]


@pytest.mark.parametrize("command", SINGLE)
def test_every_command_prints_the_version(capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert call(capsys, *command.split(), "--version") == (
        0,
        f"asbuilt {asbuilt.__version__}\n",
        "",
    )


@pytest.mark.parametrize("command", ["show", "base", "convert", "excite", "simulate", "view"])
def test_the_option_that_an_error_names_is_one_of_the_command(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    """A free joint is refused with `--fixed-base`, and held by it."""
    robot = tmp_path / "hung.xml"
    robot.write_text(
        "<mujoco><worldbody><body name='trunk'><freejoint/><inertial pos='0 0 0' mass='5'"
        " diaginertia='.1 .1 .1'/><body name='leg'><joint name='hip' axis='0 1 0'/><inertial"
        " pos='0 0 -.1' mass='1' diaginertia='.01 .01 .01'/></body></body></worldbody></mujoco>"
    )
    files = [str(tmp_path / "out.toml")] if command == "convert" else []
    err = call(capsys, command, robot, *files)[2]
    assert "--fixed-base" in err
    assert "--fixed-base" in options_of(command)
    if command in ("show", "base", "convert"):
        assert call(capsys, command, robot, *files, "--fixed-base")[0] == 0
