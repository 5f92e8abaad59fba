"""The command that watches a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import (
    ReadingOptions,
    UsageError,
    WatchOptions,
    writers,
)
from asbuilt.apps import watch as app
from asbuilt.cli import (
    AsJson,
    Full,
    Out,
    Result,
    TimelineFiles,
    answer,
    describe_cure,
    list_files,
    read_recordings_of_robot,
    require_distinct_logs,
    show_progress,
)
from asbuilt.findings import list_findings


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
    require_distinct_logs([log], calibrate)
    identified = asbuilt.read_result(result)
    given = None if thresholds is None else asbuilt.read_thresholds(thresholds)
    with show_progress() as report:
        report("read", 0.0)
        logged = read_recordings_of_robot(identified.model, [log], reading)[0]

        watched = asbuilt.watch(
            identified,
            logged,
            calibrate=read_recordings_of_robot(identified.model, calibrate, reading),
            thresholds=given,
            options=options,
            progress=report,
        )
        files = app.write_watched(out, watched) if out is not None else {}
        files |= timelines.write(
            lambda: [app.timeline_of_watched(identified.model, watched, logged)]
        )
    listed = list_findings(watched.findings, describe_cure, full=full)
    messages = "".join(f"\n{line}" for line in listed)
    answer(
        as_json,
        lambda: writers.with_files(watched.as_document(), files),
        lambda: watched.as_text(full) + messages + list_files(files),
    )
