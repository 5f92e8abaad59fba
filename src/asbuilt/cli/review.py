"""The command that judges a robot description by recordings: review."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

import asbuilt
from asbuilt import ReadingOptions, StudyOptions, writers
from asbuilt.cli.answers import answer, finding_text, listed_files, progress_bar
from asbuilt.cli.arguments.options import (
    AsJson,
    Filtering,
    Full,
    Logs,
    Out,
    Robot,
    described_robot,
    distinct_logs,
    robot_and_recordings,
)


def review(
    robot: Robot,
    log: Logs,
    *,
    cad_tolerance: Annotated[
        str | None,
        typer.Option(
            "--cad-tolerance",
            metavar="30%",
            help=(
                "plausible errors of masses, centres and inertias while another number is judged:"
                " one fraction or three"
            ),
        ),
    ] = None,
    options: StudyOptions,
    reading: ReadingOptions,
    filtering: Filtering,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Judge every number that a description claims by recordings.

    Armature, damping, friction loss, gains, masses, centres and inertias:
    supported, contradicted or undetermined, and what each is an alias of.
    """
    distinct_logs(log)
    model, swept = described_robot(robot, **reading.of_base), filtering.cutoff == "auto"
    chain = replace(filtering, cutoff=None if swept else filtering.cutoff).chain()
    with progress_bar() as report:
        report("read", 0.0)
        model, (recordings,) = robot_and_recordings(model, reading, log)
        from asbuilt.validation.comparison.cad_tolerance import CadTolerance
        from asbuilt.validation.review.review import PLAUSIBLE

        tolerance = PLAUSIBLE if cad_tolerance is None else CadTolerance.parse(cad_tolerance)
        found = asbuilt.review(
            model,
            recordings,
            tolerance=tolerance,
            options=replace(options, chain=chain, sweep_cutoff=swept),
            progress=report,
        )
        files = writers.write_review(out, found) if out is not None else {}
    answer(
        as_json,
        lambda: (
            writers.with_files(writers.review_document(found), files)
            if files
            else writers.review_document(found)
        ),
        lambda: (
            writers.review_text(found, full=full, finding_text=finding_text).rstrip("\n")
            + listed_files(files)
        ),
    )
