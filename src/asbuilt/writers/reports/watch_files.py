"""Files and pages of checked recordings and of watched logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from asbuilt.codec import format_json
from asbuilt.experiment import Recorded, RecordingCheck, Samples, head_of
from asbuilt.findings import Cure
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.workflow.watching.watched_log import WatchedLog, format_duration, format_thresholds
from asbuilt.writers.figures.figure_style import encode_figure, save_figure
from asbuilt.writers.figures.recording_figures import draw_recording, watch_figure
from asbuilt.writers.files import atomic_write
from asbuilt.writers.reports.page import (
    Block,
    Card,
    cards_markup,
    image_markup,
    list_markup,
    paragraph_markup,
    render_page,
    table_markup,
)


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
    events, thresholds, verified = watched.events, watched.thresholds, watched.rate_verified
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
    sentences = [*watched.sentences(), *(each.text for each in watched.findings)]
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


def write_check_page(
    folder: Path,
    recordings: Sequence[Recorded],
    checks: Sequence[RecordingCheck],
    cure_text: Callable[[Cure], str] = str,
) -> dict[str, Path]:
    """Write check.html, which draws each recording with its findings; return its path by kind.

    Of a long recording the beginning is drawn. `cure_text` writes a cure, for an interface
    that adds the names of its options.
    """
    blocks = []
    for k, (recording, check) in enumerate(zip(recordings, checks, strict=True)):
        mood = "bad" if check.errors else "" if check.warnings else "good"
        parts = [
            paragraph_markup(check.headline, f"verdict {mood}"),
            list_markup((each.severity, each.as_line(cure_text)) for each in check.findings),
        ]
        if not isinstance(recording, Samples):
            parts.append(
                image_markup(
                    encode_figure(draw_recording(head_of(recording), check)),
                    "Position and torque of every joint over time, with lines where findings begin;"
                    " the findings are listed above",
                )
            )
        blocks.append(Block(f"log-{k}", recording_name(check.source), parts))
    text = render_page(checks[0].robot, "recordings checked", blocks)
    return {"page": atomic_write(folder / "check.html", text)}
