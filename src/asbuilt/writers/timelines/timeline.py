"""Timeline: positions, torques and events of a recording, as viewers show them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.logs.long_recordings import RecordingStream, head_of
from asbuilt.experiment.logs.recordings import Recorded
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Finding, Severity
from asbuilt.monitoring.events import Event
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import Validation
from asbuilt.workflow.watching.watched_log import WatchedLog

SEVERITY_OF_EVENT: dict[str, Severity] = {
    "contact": "warning",
    "fault": "error",
    "payload": "info",
}


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Hold a torque of all joints over time.

    `t` [s] is (N,), or (N, n) where each joint has times of its own; `torque` (N, n) [N m or N].
    """

    name: str
    t: Array
    torque: Array

    @property
    def has_own_times(self) -> bool:
        """Whether each joint has times of its own."""
        return self.t.ndim == 2

    def joint(self, k: int) -> tuple[Array, Array]:
        """Return the times and torques of a joint."""
        return (self.t[:, k] if self.has_own_times else self.t), self.torque[:, k]


@dataclass(frozen=True, slots=True)
class Mark:
    """Hold what happened at a time [s], in a sentence."""

    time: float
    severity: Severity
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Hold a recording as a viewer shows it.

    Parameters
    ----------
    name
        Name of the recording.
    model
        The robot.
    t, q
        Times (N,) [s] and positions (N, n) [rad or m]; rows that are not known are left out.
    tracks
        Torques, each with times of its own.
    marks
        Events and findings that have a time.
    """

    name: str
    model: RobotModel
    t: Array
    q: Array
    tracks: tuple[Track, ...]
    marks: tuple[Mark, ...] = ()

    @property
    def start(self) -> float:
        """First time [s] of anything in it."""
        times = [self.t, *(track.t for track in self.tracks)]
        marked = [mark.time for mark in self.marks]
        return min([float(each.min()) for each in times if each.size] + marked, default=0.0)


def timelines_of_validations(
    model: RobotModel,
    validations: Sequence[Validation],
    recordings: Sequence[Recorded],
    findings: Iterable[Finding] = (),
) -> list[Timeline]:
    """Return a timeline of each prediction: measured, as built, by CAD, and the error as built.

    Positions are those of the recording that was predicted, at the times of the prediction.
    """
    marks = tuple(
        Mark(each.time, each.severity, each.text) for each in findings if each.time is not None
    )
    return [
        Timeline(
            recording_name(each.source),
            model,
            *_positions(model, each.source, each.t, recordings),
            (
                Track("measured", each.t, each.measured),
                Track("as_built", each.t, each.predicted),
                Track("cad", each.t, each.predicted_cad),
                Track("error", each.t, each.error),
            ),
            marks,
        )
        for each in validations
    ]


def timeline_of_watched(
    model: RobotModel, watched: WatchedLog, recording: Recording | RecordingStream
) -> Timeline:
    """Return the timeline of a watched log: measured and external torque, thresholds, events."""
    head, trace = head_of(recording), watched.trace
    marks = [
        Mark(event.start, SEVERITY_OF_EVENT[event.kind], _event_text(event))
        for event in watched.events
    ]
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
        tuple(marks),
    )


def _positions(
    model: RobotModel, source: str, t: Array, recordings: Sequence[Recorded]
) -> tuple[Array, Array]:
    """Return times and positions (N, n) of a recording at times (N,), those that it covers."""
    none = np.empty(0), np.empty((0, model.n_joints))
    own = [
        head_of(each)
        for each in recordings
        if isinstance(each, Recording | RecordingStream) and source.startswith(each.source)
    ]
    if not own:
        return none
    recording = max(own, key=lambda each: len(each.source))
    valid = np.all(np.isfinite(recording.q), axis=1)
    if not valid.any():
        return none
    logged, q = recording.t[valid], recording.q[valid]
    inside = (t >= logged[0]) & (t <= logged[-1])
    times = t[inside]
    return times, np.column_stack([np.interp(times, logged, column) for column in q.T])


def _event_text(event: Event) -> str:
    joints = ", ".join(event.joints)
    return f"{event.kind} at {joints} from {event.start:.3f} to {event.end:.3f} s"
