"""Files, timeline and page of a watched log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from asbuilt.apps.watch.watched_log import (
    WatchedLog,
    format_duration,
    format_thresholds,
    format_torque_unit,
)
from asbuilt.arrays import find_finite_rows
from asbuilt.codec import format_json
from asbuilt.description import RobotModel
from asbuilt.experiment import Recording, RecordingStream, head_of
from asbuilt.findings import Severity
from asbuilt.validation import recording_name
from asbuilt.writers import (
    BLUE,
    GREY,
    ORANGE,
    VERMILION,
    Block,
    Card,
    Mark,
    Timeline,
    Track,
    break_name,
    cards_markup,
    encode_figure,
    image_markup,
    label_once,
    list_markup,
    open_figure,
    render_page,
    save_figure,
    table_markup,
)
from asbuilt.writing import atomic_write

COLOURS = {"contact": VERMILION, "fault": ORANGE, "payload": "#009E73"}


def watch_figure(watched: WatchedLog, *, narrow: bool = False) -> Figure:
    """Draw the residual of every joint in its thresholds, with the events marked.

    A narrow figure is for screens as wide as a telephone's.
    """
    # 600: bins of a narrow figure.
    trace = watched.trace.thinned(600) if narrow else watched.trace
    n = len(watched.joint_names)
    start = float(trace.t.min())
    last = float(trace.t.max())
    subject = f"external torque [{format_torque_unit(watched.units)}] and its thresholds"
    title = subject if narrow else f"{watched.robot}: {subject}"
    mixed = len(set(watched.units)) > 1
    width = 3.9 if narrow else 8.6
    with open_figure(width, 0.95 * n + 0.9, title, rows=n, sharex=True) as (figure, axes):
        for j, (axis, name) in enumerate(zip(axes, watched.joint_names, strict=True)):
            t = trace.t[:, j]
            limit = trace.limit[:, j]
            residual = trace.residual[:, j]
            axis.fill_between(
                t, -limit, limit, color="#E9ECEF", linewidth=0.0, label="within threshold"
            )
            axis.plot(t, np.stack([limit, -limit], axis=1), color=GREY, linewidth=0.5)
            axis.plot(t, residual, color=BLUE, linewidth=0.8, label="external torque")
            for event in watched.events:
                if name in event.joints:
                    # Least width of an event, per length of the log.
                    end = event.start + max(event.duration, 0.004 * (last - start))
                    axis.axvspan(
                        event.start,
                        end,
                        label=event.kind,
                        color=COLOURS[event.kind],
                        alpha=0.3,
                        linewidth=0.0,
                    )
            tallest = 1.25 * float(max(np.abs(residual).max(), np.quantile(limit, 0.5)))
            label = f"{name} [{watched.units[j]}]" if mixed else name
            axis.set(ylim=(-tallest, tallest), ylabel=break_name(label, 12))
        axes[-1].set(xlabel="time [s]", xlim=(start, last))
        label_once(figure, axes, loc="outside lower right", ncols=2 if narrow else 5)
    return figure


def write_watched(folder: Path, watched: WatchedLog) -> dict[str, Path]:
    """Write events.json, events.csv, watch.html, watch.png and thresholds.json.

    Returns the paths by kind.
    """
    return {
        "events": atomic_write(folder / "events.json", format_json(watched.as_document())),
        "table": atomic_write(folder / "events.csv", watched.table().as_csv()),
        "report": atomic_write(folder / "watch.html", watch_html(watched)),
        "figure": save_figure(watch_figure(watched), folder / "watch.png"),
        "thresholds": atomic_write(
            folder / "thresholds.json", format_thresholds(watched.thresholds)
        ),
    }


def watch_html(watched: WatchedLog) -> str:
    """Return the page of a watched log as text."""
    events = watched.events
    thresholds = watched.thresholds
    verified = watched.rate_verified
    doubt = "" if verified else f"; not verified, from {format_duration(3600.0 * thresholds.hours)}"
    cards = [
        Card("neutral" if events else "good", str(len(events)), "events"),
        Card(
            "good" if verified else "neutral",
            f"{thresholds.false_alarms_per_hour:g} per hour",
            f"false alarms that the thresholds are set for{doubt}",
        ),
    ]
    drawn = image_markup(
        encode_figure(watch_figure(watched)),
        "Residual of the momentum observer and its thresholds at every joint; the events are in"
        " the table below",
        narrow=encode_figure(watch_figure(watched, narrow=True)),
    )
    sentences = [*watched.sentences(), *(finding.text for finding in watched.findings)]
    table = [table_markup(watched.table(), "events-table")] if events else []
    return render_page(
        watched.robot,
        watched.source,
        [
            Block("verdict", "Verdict", (cards_markup(cards), list_markup(sentences))),
            Block("torque", "External torque, joint by joint", (drawn,), "External torque"),
            Block("events", "Events", table),
        ],
    )


SEVERITY_OF_EVENT: dict[str, Severity] = {
    "contact": "warning",
    "fault": "error",
    "payload": "info",
}


def timeline_of_watched(
    model: RobotModel, watched: WatchedLog, recording: Recording | RecordingStream
) -> Timeline:
    """Return the timeline of a watched log: measured and external torque, thresholds, events."""
    head = head_of(recording)
    trace = watched.trace
    valid = find_finite_rows(head.q)
    return Timeline(
        recording_name(watched.source),
        model,
        head.t[valid],
        head.q[valid],
        (
            Track("measured", head.t, head.tau),
            Track("external", trace.t, trace.residual),
            Track("threshold", trace.t, trace.limit),
        ),
        tuple(
            Mark(
                event.start,
                SEVERITY_OF_EVENT[event.kind],
                f"{event.kind} at {', '.join(event.joints)} from {event.start:.3f} to"
                f" {event.end:.3f} s",
            )
            for event in watched.events
        ),
    )
