"""Complete runs: the demonstration and the reproduction of the 2015 paper."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt.cli import (
    AsJson,
    Full,
    Out,
    answer,
    list_files,
    out_folder,
    require_known_value,
    show_progress,
)
from asbuilt.registry import find_app_modules


def reproduce(out: Out = None, full: Full = False, as_json: AsJson = False) -> None:
    """Reproduce the 2015 paper, table by table and figure by figure.

    A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic Identification of Manipulator (2015). Its
    recordings are not public; a virtual robot stands in for the robot of Table 3.
    """
    from asbuilt.apps.paper.pages import (
        describe_reproduction,
        reproduction_document,
        write_reproduction,
    )

    with show_progress() as report:
        redone = asbuilt.reproduce_paper(progress=report)
        files = write_reproduction(out, redone) if out is not None else {}
    answer(
        as_json,
        lambda: reproduction_document(redone, files),
        lambda: describe_reproduction(redone, full) + list_files(files),
    )


def demo(
    which: Annotated[
        str,
        typer.Argument(metavar="[WHICH]", help="arm (the whole story of one) or fleet"),
    ] = "arm",
    *,
    out: Annotated[Path, out_folder()] = Path("asbuilt-demo"),
    as_json: AsJson = False,
) -> None:
    """Run a complete example on bundled data.

    arm: move, record, identify, validate, compare, export, report. fleet: ten robots over ten
    days, of which one changes, kept in a ledger.
    """
    # Another app's demonstration is called as the app; each module has the three functions.
    stories = {name.split(".")[-2]: name for name in find_app_modules("demo")}
    stories = {"arm": stories.pop("paper"), **stories}
    story = import_module(require_known_value("WHICH", which, stories))
    with show_progress() as report:
        done = story.run_demo(out, progress=report)
    answer(as_json, lambda: story.demo_document(done), lambda: story.describe_demo(done))
