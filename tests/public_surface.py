"""What asbuilt promises to keep within a major version: names, options, JSON fields, files.

`python tests/public_surface.py` records it after a change on purpose; what then is missing from the
record in comparison with the last release asks for a new major version.
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import typer

ROOT = Path(__file__).parents[1]
RECORD = Path(__file__).with_suffix(".json")
Surface = dict[str, dict[str, list[str]]]


def list_surface() -> Surface:
    """Return what is public, by kind and place, in alphabetical order."""
    from asbuilt.cli.app import app

    return {
        "names": _list_names(),
        "options": dict(_list_options(typer.main.get_command(app), "asbuilt")),
        "json": _list_words("json.md", 1, r"`([a-z]\w*)`"),
        "files": _list_words("files.md", 2, r"`([\w-]+\.\w+)`"),
    }


def _list_names() -> dict[str, list[str]]:
    """Return what each stub exports."""
    package = ROOT / "src/asbuilt"
    stubs = (*package.glob("__init__.pyi"), *package.rglob("*/__init__.pyi"))
    return {
        ".".join(stub.parent.relative_to(package.parent).parts): sorted(
            alias.asname or alias.name
            for node in ast.parse(stub.read_text("utf-8")).body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        )
        for stub in sorted(set(stubs))
    }


def _list_options(command: Any, place: str) -> list[tuple[str, list[str]]]:
    """Return the options of a command and of those below it; arguments stand by their place."""
    own = sorted(
        word
        for each in command.params
        if not getattr(each, "hidden", False)
        for word in (*each.opts, *each.secondary_opts)
    )
    found = [(place, own)]
    if hasattr(command, "list_commands"):
        context = typer.Context(command)
        for name in sorted(command.list_commands(context)):
            found += _list_options(command.get_command(context, name), f"{place} {name}")
    return found


def _list_words(page: str, column: int, pattern: str) -> dict[str, list[str]]:
    """Return the words in a column of a page's tables, by the heading above."""
    found: dict[str, set[str]] = {}
    heading = "page"
    for line in (ROOT / "docs/reference" / page).read_text("utf-8").splitlines():
        if line.startswith("#"):
            heading = line.strip("# `")
        elif line.startswith("| "):
            found.setdefault(heading, set()).update(re.findall(pattern, line.split("|")[column]))
    return {heading: sorted(words) for heading, words in found.items() if words}


def find_lost(before: Surface, now: Surface) -> list[str]:
    """Return what was public and is no more."""
    return [
        f"{kind}: {place}: {word}"
        for kind, places in before.items()
        for place, words in places.items()
        for word in words
        if word not in now.get(kind, {}).get(place, [])
    ]


def find_last_release(tree: Path = ROOT) -> tuple[str, Surface] | None:
    """Return the newest tag of a version and its record; None without git, tags or a record."""
    git = ["git", "-C", str(tree)]
    newest = ["tag", "--list", "v*", "--sort=-version:refname"]
    try:
        tags = subprocess.run([*git, *newest], capture_output=True, text=True, check=True).stdout
        if not tags:
            return None
        tag = tags.split()[0]
        show = [*git, "show", f"{tag}:tests/{RECORD.name}"]
        told = subprocess.run(show, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return tag, json.loads(told)


if __name__ == "__main__":
    surface = list_surface()
    RECORD.write_text(json.dumps(surface, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
