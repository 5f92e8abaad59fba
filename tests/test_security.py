"""Every promise of SECURITY.md names tests that exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROMISES = ("size", "memory", "disk", "one answer", "secret", "other users")


def list_promises() -> dict[str, list[str]]:
    """The tests that the page names, by the promise they hold."""
    page = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    table = page.partition("## What holds each promise")[2].partition("\n## ")[0]
    rows = [line.split("|") for line in table.splitlines() if "`tests/" in line]
    return {row[1].strip(): re.findall(r"`(tests/[^`]+)`", row[2]) for row in rows}


@pytest.mark.parametrize("promise", PROMISES)
def test_each_promise_has_a_test(promise: str) -> None:
    assert [tests for named, tests in list_promises().items() if promise in named]


@pytest.mark.apps("fleet", "masses", "page")
@pytest.mark.parametrize(
    "named", sorted({each for row in list_promises().values() for each in row})
)
def test_each_named_test_exists(named: str) -> None:
    path, _, function = named.partition("::")
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    names = {each.name for each in tree.body if isinstance(each, ast.FunctionDef)}
    assert function in names if function else any(name.startswith("test_") for name in names)
