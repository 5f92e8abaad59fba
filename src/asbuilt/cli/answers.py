"""How the commands answer.

One document or one text on stdout, progress on stderr, the files they wrote.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def answer(as_json: bool, document: Callable[[], dict[str, Any]], text: Callable[[], str]) -> None:
    """Print the document or the text on stdout."""
    if as_json:
        from asbuilt.writers.tables.tabular import json_text

        sys.stdout.write(json_text(document()))
    else:
        sys.stdout.write(text().strip("\n") + "\n")
    sys.stdout.flush()


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield `report(what, fraction)`.

    Draws a bar on stderr where that is a terminal, for anything that takes over a second.
    """
    if not sys.stderr.isatty():
        yield lambda what, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    tasks: dict[str, Any] = {}

    def report(what: str, fraction: float) -> None:
        stage = what.split(":", maxsplit=1)[0]
        if stage not in tasks:
            for task in tasks.values():
                bar.update(task, completed=1.0)
            tasks[stage] = bar.add_task(what, total=1.0)
        bar.update(tasks[stage], description=what, completed=fraction)

    with bar:
        yield report


def listed_files(
    files: Mapping[str, Path], notes: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Return the lines that say which files were written and what is to be known of them, empty
    where none were.
    """
    if not files:
        return ""
    from asbuilt.writers.files import file_lines

    return "\n".join(
        [
            "",
            "",
            "written:",
            *file_lines(files, notes or {}, max((*(len(kind) for kind in files), 11))),
        ]
    )
