"""The command that writes a controller program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt.apps import programs as app
from asbuilt.cli import (
    AsJson,
    Full,
    Robot,
    answer,
    list_files,
    out_folder,
)


def program(
    robot: Robot,
    motion: Annotated[
        Path,
        typer.Argument(
            metavar="MOTION", help="motion CSV (t, q_*, ...), as `asbuilt excite` writes it"
        ),
    ],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="sunrise, fri, ros2, urscript, franka, csv or an installed one",
        ),
    ],
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            min=0.1,
            max=1e5,
            help="rate of points or recording (default: by format)",
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option("--name", help="name of the motion and its files (default: the file's)"),
    ] = None,
    collision: Annotated[
        str | None,
        typer.Option(
            "--collision",
            metavar="SOURCE",
            help="state the smallest distance and refuse collisions, as for excite",
        ),
    ] = None,
    out: Annotated[Path, out_folder()] = Path("program"),
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Write a program that makes a real controller run a motion and record it."""
    model = asbuilt.load_robot(robot)
    title = name or motion.stem

    request = app.program_request(model, motion, form, name=title, rate=rate, collision=collision)
    files = app.write_program(out, app.program_format(form).files(request))
    answer(
        as_json,
        lambda: app.program_document(request, form, files),
        lambda: app.program_text(request, form, full=full) + list_files(files),
    )
