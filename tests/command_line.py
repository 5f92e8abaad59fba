"""The command line as the tests call it, in this process."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from asbuilt.cli import main
from asbuilt.cli.commands import SUBCOMMANDS

JSON_PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "json.md"
EXTRA = {
    "check": {"files"},
    "identify": {"payload", "cutoff_sweep", "rollout", "refined"},
    "validate": {"rollout", "verdict", "headline", "use", "load"},
}
"""Fields that some options of a command add."""
IN_LINES = ("run",)
"""Commands that print a document a line."""


CALLS = """
import contextlib, io, json, sys
from asbuilt.cli.app import main
printed = []
for line in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            main(line.split())
        except SystemExit as end:
            if end.code:
                sys.exit(end.code)
    printed.append(out.getvalue())
print(json.dumps(printed))
"""


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Run a command; returns exit status, stdout, stderr.

    A document that it printed must have the fields of the documentation.
    """
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    status = int(end.value.code or 0)
    if status == 0 and "--json" in arguments:
        command = str(arguments[0])
        if command in SUBCOMMANDS:
            command = f"{command} {arguments[1]}"
        for text in out.splitlines() if command in IN_LINES else [out]:
            fields = set(json.loads(text)) - EXTRA.get(command, set())
            assert any(fields == told for told in documented_fields()[command]), sorted(fields)
    return status, out, err


def document(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Run a command that must succeed with --json; returns what it printed."""
    status, out, err = call(capsys, *arguments, "--json")
    assert status == 0, err
    return json.loads(out)


def call_elsewhere(folder: Path, site: Path, *lines: str) -> list[str]:
    """Run commands that must succeed, in one new process that also has the distributions of `site`.

    Returns what each printed on stdout.
    """
    done = subprocess.run(
        [sys.executable, "-c", CALLS, *lines],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{lines}\n{done.stdout}{done.stderr}"
    return list(json.loads(done.stdout))


@cache
def documented_fields() -> dict[str, list[set[str]]]:
    """The fields of every command's JSON by `docs/reference/json.md`: a set for each table."""
    told: dict[str, list[set[str]]] = {}
    for line in JSON_PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            tables = told.setdefault(line.removeprefix("## ").strip("`"), [])
        elif line.startswith("| field"):
            tables.append(set())
        elif line.startswith("| `"):
            tables[-1] |= set(re.findall(r"`([^`]+)`", line.split("|")[1]))
    return told
