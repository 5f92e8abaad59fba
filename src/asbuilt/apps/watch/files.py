"""Files and the page of a watched log."""

from __future__ import annotations

from pathlib import Path

from asbuilt.apps.watch.figure import watch_figure
from asbuilt.apps.watch.watched_log import WatchedLog, format_duration, format_thresholds
from asbuilt.codec import format_json
from asbuilt.writers import (
    Block,
    Card,
    cards_markup,
    encode_figure,
    image_markup,
    list_markup,
    render_page,
    save_figure,
    table_markup,
)
from asbuilt.writing import atomic_write


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
