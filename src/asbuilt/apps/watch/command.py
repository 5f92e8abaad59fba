"""The command that watches a log."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

import asbuilt
from asbuilt import (
    ReadingOptions,
    UsageError,
    WatchOptions,
    writers,
)
from asbuilt.apps import watch as app
from asbuilt.apps.watch import Event, Observer
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
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="the recording to watch; - : rows from standard input"),
    ],
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
    identified = asbuilt.read_result(result)
    given = None if thresholds is None else asbuilt.read_thresholds(thresholds)
    if log == Path("-"):
        if out is not None or timelines.mcap or timelines.rrd:
            raise UsageError("a stream is printed as it comes; files are of logs")
        observer = app.make_stream_observer(
            identified,
            calibrate=read_recordings_of_robot(identified.model, calibrate, reading),
            thresholds=given,
            options=options,
        )
        _watch_standard_input(observer, options, reading, as_json=as_json)
        return
    require_distinct_logs([log], calibrate)
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


def _watch_standard_input(
    observer: Observer, options: WatchOptions, reading: ReadingOptions, *, as_json: bool
) -> None:
    """Print events of rows from standard input as they begin and end, then how many there were."""

    def put(kind: str, text: str, content: dict[str, Any]) -> None:
        line = json.dumps({"event": kind, **content}) if as_json else text
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()

    def tell(text: str) -> None:
        sys.stderr.write(f"asbuilt watch: {text}\n")
        sys.stderr.flush()

    def begun(t: float, joint: str, torque: float, limit: float) -> None:
        content = {"time": t, "joint": joint, "torque": torque, "threshold": limit}
        text = f"{t:.3f} s  begins: {joint} {torque:.3g}, its threshold {limit:.3g} N m or N"
        put("begin", text, content)

    def ended(event: Event) -> None:
        carried = "" if event.mass is None else f", {event.mass:.3g} kg"
        text = (
            f"{event.end:.3f} s  {event.kind} of {event.duration:.3f} s is over: at {event.link},"
            f" {', '.join(event.joints)}{carried}"
        )
        put("end", text, event.as_document())

    watching = app.StreamWatch(observer, options.frame, begun, ended)
    tell("watching standard input")
    rows = app.watch_stream(app.read_lines(sys.stdin.fileno(), tell), watching, tell, reading)
    counts = {
        "n_samples": watching.n_samples,
        "n_events": watching.n_events,
        "left_out": watching.left_out,
        "unreadable": rows.broken,
    }
    text = (
        f"the stream ended: {watching.n_samples} samples, {watching.n_events} events,"
        f" {watching.left_out} samples left out, {rows.broken} lines unreadable"
    )
    put("stream ended", text, counts)
