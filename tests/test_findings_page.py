"""The table of findings in the documentation agrees with the source."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

from parsed_source import SOURCE, nodes_of

HOUSE = Path(__file__).resolve().parents[1]
PAGE = HOUSE / "docs" / "reference" / "findings.md"
MAKERS = {"Finding", "make_link_finding"}
SEVERITIES = {"error", "warning", "info"}


@cache
def findings_in_source() -> dict[str, set[str]]:
    """Return the severities of each code that the source writes out."""
    found: dict[str, set[str]] = {}
    for path in SOURCE.rglob("*.py"):
        for node in nodes_of(path):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
                continue
            if node.func.id not in MAKERS or not node.args or path.name == "findings.py":
                continue
            code = node.args[0]
            if isinstance(code, ast.Constant):
                words = {
                    each.value for each in ast.walk(node.args[1]) if isinstance(each, ast.Constant)
                }
                found.setdefault(code.value, set()).update(words & SEVERITIES)
            else:
                assert node.func.id == "Finding", f"{path}: the code of a finding is no literal"
    return found


def findings_in_table() -> dict[str, set[str]]:
    """Return the severities of each code in the table."""
    rows = re.findall(
        r"^\| `(\w+)` \| ([^|]+) \|([^|]+)\|([^|]+)\|$", PAGE.read_text(), re.MULTILINE
    )
    codes = [row[0] for row in rows]
    assert len(codes) == len(set(codes)), "a code is listed twice"
    assert all(meaning.strip() and cure.strip() for _, _, meaning, cure in rows)
    return {code: set(severity.split(" or ")) for code, severity, _, _ in rows}


def test_table_lists_every_code_of_the_source() -> None:
    source, table = findings_in_source(), findings_in_table()
    assert set(source) == set(table)
    assert {code: words for code, words in source.items() if not words <= table[code]} == {}


def test_codes_are_snake_case() -> None:
    assert [
        code for code in findings_in_source() if not re.fullmatch(r"[a-z]+(_[a-z]+)*", code)
    ] == []
