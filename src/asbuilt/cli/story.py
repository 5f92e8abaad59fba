"""Commands that tell a whole story: the 2015 paper and the demonstration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from asbuilt.cli.answers import answer, listed_files, progress_bar
from asbuilt.cli.options import AsJson, Out, writable_folder


def reproduce(out: Out = None, as_json: AsJson = False) -> None:
    """Redo the 2015 paper that asbuilt grew from, table by table and figure by figure."""
    from asbuilt.cli.reproduce import reproduce as redo
    from asbuilt.cli.reproduce_tables import (
        reproduction_document,
        reproduction_text,
        write_reproduction,
    )

    with progress_bar() as report:
        redone = redo(progress=report)
        files = write_reproduction(out, redone) if out is not None else {}
    answer(
        as_json,
        lambda: reproduction_document(redone, files),
        lambda: reproduction_text(redone) + listed_files(files),
    )


def demo(
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="folder for the files to write", callback=writable_folder
        ),
    ] = Path("asbuilt-demo"),
    as_json: AsJson = False,
) -> None:
    """Run the whole story on bundled data.

    Move, record, identify, validate, compare, export, report.
    """
    from asbuilt.cli.demo import demo_document, demo_text, run_demo

    with progress_bar() as report:
        story = run_demo(out, progress=report)
    answer(as_json, lambda: demo_document(story), lambda: demo_text(story))
