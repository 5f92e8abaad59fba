"""Write the pages of the reference that follow from the code: options, and names of each stage.

`python docs/build_reference.py` renews them; a test compares them with the code. They are kept, so
that they can be read without a build.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer.main import get_command

from asbuilt.cli.app import app
from asbuilt.cli.commands import SUBCOMMANDS

REFERENCE = Path(__file__).resolve().parent / "reference"
STUB = REFERENCE.parents[1] / "src" / "asbuilt" / "__init__.pyi"

OPTIONS = "## Every option of every command\n"
"""Heading of the part of cli.md that is written here."""

ON_ALL = {"--help", "--json", "--quiet", "--verbose", "--version"}
"""Options of every command, listed once."""

STAGES = {
    "description": "robots, links and their inertia, from files",
    "dynamics": "inverse and forward dynamics, regressors, base parameters, drives",
    "excitation": "motions, designed and random",
    "experiment": "recordings: read, checked, filtered, simulated",
    "identification": "estimation from samples, intervals, ensembles",
    "validation": "prediction, comparison with CAD and its causes",
    "workflow": "whole studies: identify, validate, payloads, gains, rollouts",
    "writers": "models, motions, results, reports and pictures as files",
}
APPS = {
    "fleet": "many robots over time",
    "masses": "mass properties from geometry and material",
    "paper": "the demonstration, and the 2015 paper",
    "programs": "motions as programs of controllers",
    "watch": "external torque, contact and fault",
}
LEAVES = {
    "errors": "what is raised, and what a finding says",
}
LEAF_MODULES = ("errors", "executor", "findings")
"""Modules of no stage; their names share a page."""


def build_pages() -> dict[str, str]:
    """Return the text of each page, by its path below the reference."""
    named = _list_public_names()
    titles = {**STAGES, **{f"apps-{name}": text for name, text in APPS.items()}, **LEAVES}
    pages = {f"api/{page}.md": _write_stage(page, titles[page], named[page]) for page in titles}
    pages["api/index.md"] = _write_index(titles, named)
    manual = (REFERENCE / "cli.md").read_text(encoding="utf-8").partition(OPTIONS)[0]
    pages["cli.md"] = manual + OPTIONS + "\n" + "\n".join(_write_commands())
    return pages


def _list_public_names() -> dict[str, list[str]]:
    """Return the public names of the package by their page."""
    named: dict[str, list[str]] = {}
    for node in ast.parse(STUB.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            first, *below = str(node.module).split(".")
            page = f"apps-{below[0]}" if first == "apps" else first
            page = "errors" if first in LEAF_MODULES else page
            named.setdefault(page, []).extend(str(alias.asname) for alias in node.names)
    return named


def _write_stage(page: str, text: str, names: list[str]) -> str:
    title = page.removeprefix("apps-")
    kind = "app" if title != page else "stage"
    home = f" of the {kind} `asbuilt.{page.replace('-', '.')}`" if page not in LEAVES else ""
    lines = [f"# {title.capitalize()}", "", f"Names{home}, {text}. All are also in `asbuilt`."]
    return "\n".join([*lines, *(f"\n::: asbuilt.{name}" for name in names)]) + "\n"


def _write_index(titles: dict[str, str], named: dict[str, list[str]]) -> str:
    lines = [
        "# Python interface",
        "",
        "Every command is one function of `asbuilt` with one options object and one result; a name"
        " loads its module on first use. `identify` takes every option as a keyword too; the error"
        " for a wrong one names the nearest. Functions accept robots as a `RobotModel`, the name of"
        " a bundled robot or a path, and recordings as paths, pandas or polars data frames,"
        " dictionaries of arrays, `Recording` objects, or lists of these.",
        "",
        "A stage uses the stages above it; apps use public names only.",
        "",
        "| page | contents | names |",
        "|---|---|---|",
    ]
    for page, text in titles.items():
        names = ", ".join(f"[`{name}`]({page}.md#asbuilt.{name})" for name in named[page])
        shown = f"app {page.removeprefix('apps-')}" if page.startswith("apps-") else page
        lines.append(f"| [{shown}]({page}.md) | {text} | {names} |")
    return "\n".join(lines) + "\n"


def _write_commands() -> Iterator[str]:
    """Return a table of options for each command, as `asbuilt COMMAND -h` lists them."""
    yield (
        "Written from the command line itself. Every command has `-h`/`--help`, `--json`,"
        " `-q`/`--quiet`, `-v`/`--verbose` and `--version`.\n"
    )
    for name, command in list_commands():
        context = command.context_class(command)
        params = [param for param in command.get_params(context) if _is_listed(param)]
        rows = [_describe_option(*param.get_help_record(context)) for param in params]
        if rows:
            yield f"### `asbuilt {name}`\n"
            yield "| option | meaning |\n|---|---|\n" + "\n".join(rows) + "\n"


def list_commands() -> Iterator[tuple[str, Any]]:
    """Return each command with its full name, in the order of the help."""
    group = get_command(app)
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        if name in SUBCOMMANDS:
            for below in command.list_commands(None):
                yield f"{name} {below}", command.get_command(None, below)
        else:
            yield name, command


def _is_listed(param: Any) -> bool:
    return param.param_type_name == "option" and not ON_ALL & {*param.opts} and not param.hidden


def _describe_option(names: str, text: str) -> str:
    """Return a row of a table, of the record that the help shows."""
    shown = " ".join(text.split())
    for sign, escaped in (("<", "&lt;"), ("*", "\\*"), ("|", "\\|")):
        shown = shown.replace(sign, escaped)
    return f"| `{names.replace('|', ' or ')}` | {shown} |"


def main() -> None:
    """Write the pages."""
    for name, text in build_pages().items():
        (REFERENCE / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
