"""Complete runs: the demonstration and the reproduction of the 2015 paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from asbuilt.cli.answers import answer, listed_files, progress_bar
from asbuilt.cli.arguments.options import AsJson, Full, Out, writable_folder


def reproduce(out: Out = None, full: Full = False, as_json: AsJson = False) -> None:
    """Reproduce the 2015 paper, table by table and figure by figure.

    A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic Identification of Manipulator (2015). Its
    recordings are not public; a virtual robot stands in for the robot of Table 3.
    """
    from asbuilt.cli.hayat2015.pages import (
        reproduction_document,
        reproduction_text,
        write_reproduction,
    )
    from asbuilt.cli.hayat2015.reproduction import reproduce_paper

    with progress_bar() as report:
        redone = reproduce_paper(progress=report)
        files = write_reproduction(out, redone) if out is not None else {}
    answer(
        as_json,
        lambda: reproduction_document(redone, files),
        lambda: reproduction_text(redone, full) + listed_files(files),
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
    from asbuilt.cli.demos.arm import demo_document, demo_text, run_demo

    with progress_bar() as report:
        story = run_demo(out, progress=report)
    answer(as_json, lambda: demo_document(story), lambda: demo_text(story))
