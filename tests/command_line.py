"""The command line as the tests call it, in this process."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from asbuilt.cli.app import main
from asbuilt.cli.commands import SUBCOMMANDS

JSON_PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "json.md"
EXTRA = {
    "identify": {"payload", "cutoff_sweep", "rollout", "refined"},
    "validate": {"rollout", "verdict"},
}
"""Fields that some options of a command add."""


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
        fields = set(json.loads(out)) - EXTRA.get(command, set())
        assert any(fields == told for told in documented_fields()[command]), sorted(fields)
    return status, out, err


def document(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Run a command that must succeed with --json; returns what it printed."""
    status, out, err = call(capsys, *arguments, "--json")
    assert status == 0, err
    return json.loads(out)


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
