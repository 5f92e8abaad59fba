"""The command that watches a log: watch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import ReadingOptions, UsageError, WatchOptions, writers
from asbuilt.cli.answers import answer, finding_text, listed_files, progress_bar, wrapped
from asbuilt.cli.arguments.options import (
    AsJson,
    Full,
    Out,
    Result,
    distinct_logs,
    recordings_of,
)
from asbuilt.cli.arguments.timelines import TimelineFiles


def watch(
    result: Result,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="the recording to watch")],
    *,
    calibrate: Annotated[
        list[Path] | None,
        typer.Option(
            "--calibrate",
            metavar="LOG",
            help="a recording without contact that sets the thresholds; repeat for more",
        ),
    ] = None,
    thresholds: Annotated[
        Path | None,
        typer.Option(
            "--thresholds", metavar="FILE", help="thresholds.json that an earlier watch wrote"
        ),
    ] = None,
    options: WatchOptions,
    reading: ReadingOptions,
    timelines: TimelineFiles,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Watch a log for external torque, contact and fault.

    Thresholds are set for a stated rate of false alarms on recordings without contact. Forces are
    those on the robot, at the tool, in root axes.
    """
    if calibrate and thresholds is not None:
        raise UsageError("--thresholds and --calibrate exclude each other; give one of them")
    distinct_logs([log], calibrate)
    identified = asbuilt.read_result(result)
    given = None if thresholds is None else asbuilt.read_thresholds(thresholds)
    with progress_bar() as report:
        report("read", 0.0)
        logged = recordings_of(identified.model, [log], reading)[0]
        quiet = recordings_of(identified.model, calibrate, reading)

        watched = asbuilt.watch(
            identified,
            logged,
            calibrate=quiet,
            thresholds=given,
            options=options,
            progress=report,
        )
        files = writers.write_watched(out, watched) if out is not None else {}
        files |= timelines.write(
            lambda: [writers.timeline_of_watched(identified.model, watched, logged)]
        )
    said = "".join(wrapped(finding_text(each)) + "\n" for each in watched.findings)
    answer(
        as_json,
        lambda: writers.with_files(watched.as_document(), files),
        lambda: watched.as_text(full) + ("\n" + said if said else "") + listed_files(files),
    )
