"""The timeline of a watched log."""

from __future__ import annotations

import numpy as np

from asbuilt.apps.watch.watched_log import WatchedLog
from asbuilt.description import RobotModel
from asbuilt.experiment import Recording, RecordingStream, head_of
from asbuilt.findings import Severity
from asbuilt.validation import recording_name
from asbuilt.writers import Mark, Timeline, Track

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
    valid = np.all(np.isfinite(head.q), axis=1)
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
