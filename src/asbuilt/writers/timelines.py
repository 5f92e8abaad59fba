"""Timelines as MCAP, for Foxglove and PlotJuggler, and for rerun with the moving robot.

In MCAP each torque is a topic of `sensor_msgs/msg/JointState` with the torque as effort; positions
are one too. Events are `rcl_interfaces/msg/Log`.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array, find_finite_rows
from asbuilt.children import open_scratch
from asbuilt.description import ROOT, RobotModel, link_solids
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MissingExtraError
from asbuilt.experiment import Recorded, Recording, RecordingStream, head_of
from asbuilt.findings import Finding, Severity
from asbuilt.validation import Validation, recording_name
from asbuilt.writers.pictures.skeleton import build_round_mesh
from asbuilt.writers.pictures.viewer import BODY_COLOURS
from asbuilt.writing import atomic_write

STATE = "sensor_msgs/msg/JointState"
LOG = "rcl_interfaces/msg/Log"
LEVELS: dict[Severity, tuple[int, str]] = {
    "info": (20, "INFO"),
    "warning": (30, "WARN"),
    "error": (40, "ERROR"),
}
"""Levels of `rcl_interfaces/msg/Log` and of rerun."""


def write_mcap(path: str | os.PathLike[str], timelines: Sequence[Timeline]) -> Path:
    """Write timelines as one MCAP file; several recordings have topics of their own.

    Times are as recorded, from the first on if that is negative.

    Raises
    ------
    MissingExtraError
        If mcap or rosbags is not installed.
    """
    try:
        from mcap.writer import Writer  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtraError("mcap", "bags", f"writing {path}") from error
    stream = io.BytesIO()
    written = list[tuple[int, int, bytes]]()
    writer: Any = Writer(stream)
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer.start(profile="ros2", library="asbuilt")
    schemas = {
        kind: writer.register_schema(
            kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode()
        )
        for kind in (STATE, LOG)
    }
    for timeline in timelines:
        prefix = f"/{timeline.folder}" if len(timelines) > 1 else ""
        begin = min(timeline.start, 0.0)
        for topic, kind, messages in _list_topics(timeline):
            channel = writer.register_channel(f"{prefix}/{topic}", "cdr", schemas[kind])
            for time, fields in messages:
                nanoseconds = round((time - begin) * 1e9)
                data = _serialise_message(store, kind, nanoseconds, fields)
                written.append((nanoseconds, channel, data))
    # Viewers read messages in the order of time.
    for nanoseconds, channel, data in sorted(written, key=itemgetter(0)):
        writer.add_message(channel, nanoseconds, data, nanoseconds)
    writer.finish()
    return atomic_write(path, stream.getvalue())


def _list_topics(
    timeline: Timeline,
) -> Iterator[tuple[str, str, list[tuple[float, dict[str, Any]]]]]:
    """Yield each topic of a timeline, its type, and times and fields of its messages."""
    names = list(timeline.model.joint_names)
    for track in timeline.tracks:
        samples = _list_samples(track, names)
        yield track.name, STATE, [(t, {"name": own, "effort": x}) for t, own, x in samples]
    poses = zip(timeline.t.tolist(), timeline.q, strict=True)
    yield "position", STATE, [(t, {"name": names, "position": q}) for t, q in poses]
    marks = [(mark.time, mark.severity, mark.text) for mark in timeline.marks]
    yield "events", LOG, [(t, {"level": LEVELS[kind][0], "msg": text}) for t, kind, text in marks]


def _serialise_message(store: Any, kind: str, nanoseconds: int, fields: Mapping[str, Any]) -> bytes:
    """Return a message of a type, the fields that are not given empty."""
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    none = dict.fromkeys(("position", "velocity", "effort"), np.empty(0))
    usual: dict[str, dict[str, Any]] = {
        STATE: {"header": header, **none},
        LOG: {"stamp": stamp, "name": "asbuilt", "file": "", "function": "", "line": 0},
    }
    return bytes(store.serialize_cdr(types[kind](**{**usual[kind], **fields}), kind))


def _list_samples(track: Track, names: list[str]) -> Iterator[tuple[float, list[str], Array]]:
    """Yield time, joints and their torques, of one joint each where it has times of its own."""
    if track.t.ndim == 1:
        for time, torque in zip(track.t.tolist(), track.torque, strict=True):
            yield time, names, np.ascontiguousarray(torque)
        return
    for k, name in enumerate(names):
        for time, value in zip(*(values.tolist() for values in track.joint(k)), strict=True):
            yield time, [name], np.array([value])


TRACK_COLOURS: dict[str, tuple[int, int, int]] = {
    "measured": (0, 114, 178),
    "as_built": (213, 94, 0),
    "cad": (125, 131, 140),
    "error": (0, 158, 115),
    "external": (0, 158, 115),
    "threshold": (179, 38, 30),
}
"""Colours of the report."""


def write_rrd(path: str | os.PathLike[str], timelines: Sequence[Timeline]) -> Path:
    """Write timelines as one file of rerun; several recordings have folders of their own.

    Raises
    ------
    MissingExtraError
        If rerun is not installed.
    """
    try:
        import rerun  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtraError("rerun-sdk", "rerun", f"writing {path}") from error
    with open_scratch() as folder:
        file = Path(folder) / "timeline.rrd"
        stream = rerun.RecordingStream("asbuilt", recording_id="asbuilt")
        stream.save(file)
        for timeline in timelines:
            above = [timeline.folder] if len(timelines) > 1 else []
            _write_timeline(rerun, stream, timeline, above)
        stream.flush()
        stream.disconnect()
        return atomic_write(path, file.read_bytes())


def _write_timeline(rerun: Any, stream: Any, timeline: Timeline, above: list[str]) -> None:
    _write_robot(rerun, stream, timeline, [*above, "robot"])
    for k, joint in enumerate(timeline.model.joint_names):
        for track in timeline.tracks:
            place = [*above, "torque", joint, track.name]
            t, torque = track.joint(k)
            valid = np.isfinite(torque)
            lines = rerun.SeriesLines(colors=TRACK_COLOURS[track.name], names=track.name)
            stream.log(place, lines, static=True)
            stream.send_columns(
                rerun.new_entity_path(place),
                [rerun.TimeColumn("time", duration=t[valid])],
                rerun.Scalars.columns(scalars=torque[valid]),
            )
    if timeline.marks:
        texts = rerun.TextLog.columns(
            text=[mark.text for mark in timeline.marks],
            level=[LEVELS[mark.severity][1] for mark in timeline.marks],
        )
        times = rerun.TimeColumn("time", duration=np.array([mark.time for mark in timeline.marks]))
        stream.send_columns(rerun.new_entity_path([*above, "events"]), [times], texts)


def _write_robot(rerun: Any, stream: Any, timeline: Timeline, place: list[str]) -> None:
    """Write the bodies of the links once, and their poses over time."""
    model = timeline.model
    links = [[*place, f"{k + 1} {link.name}"] for k, link in enumerate(model.links)]
    for number, solid in enumerate(link_solids(model)):
        parent = place if solid.link == ROOT else links[solid.link]
        vertices, faces = build_round_mesh(solid)
        mesh = rerun.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces,
            albedo_factor=BODY_COLOURS[solid.kind],
        )
        stream.log([*parent, f"{solid.kind} {number}"], mesh, static=True)
    if not len(timeline.t):
        return
    poses = link_poses(model, timeline.q)
    times = rerun.TimeColumn("time", duration=timeline.t)
    for k, link in enumerate(links):
        columns = rerun.Transform3D.columns(
            translation=poses[:, k, :3, 3], mat3x3=poses[:, k, :3, :3]
        )
        stream.send_columns(rerun.new_entity_path(link), [times], columns)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Hold a torque of all joints over time.

    `t` [s] is (N,), or (N, n) where each joint has times of its own; `torque` (N, n) [N m or N].
    """

    name: str
    t: Array
    torque: Array

    def joint(self, k: int) -> tuple[Array, Array]:
        """Return the times and torques of a joint."""
        return (self.t if self.t.ndim == 1 else self.t[:, k]), self.torque[:, k]


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
    def folder(self) -> str:
        """The name in letters and digits, as paths of topics and entities have it."""
        return "".join(c if c.isalnum() else "_" for c in self.name)

    @property
    def start(self) -> float:
        """First time [s] of anything in it."""
        times = [self.t, *(track.t for track in self.tracks)]
        firsts = [float(instants.min()) for instants in times if instants.size]
        return min([*firsts, *(mark.time for mark in self.marks)], default=0.0)


def timelines_of_validations(
    model: RobotModel,
    validations: Sequence[Validation],
    recordings: Sequence[Recorded],
    findings: Iterable[Finding] = (),
) -> list[Timeline]:
    """Return a timeline of each prediction: measured, as built, by CAD, and the error as built.

    Positions come from the recording that was predicted, at the times of the prediction.
    """
    marks = tuple(
        Mark(finding.time, finding.severity, finding.text)
        for finding in findings
        if finding.time is not None
    )
    return [
        Timeline(
            recording_name(validation.source),
            model,
            *_interpolate_positions(model, validation.source, validation.t, recordings),
            (
                Track("measured", validation.t, validation.measured),
                Track("as_built", validation.t, validation.predicted),
                Track("cad", validation.t, validation.predicted_cad),
                Track("error", validation.t, validation.error),
            ),
            marks,
        )
        for validation in validations
    ]


def _interpolate_positions(
    model: RobotModel, source: str, t: Array, recordings: Sequence[Recorded]
) -> tuple[Array, Array]:
    """Return times and positions (N, n) of a recording at times (N,), those that it covers."""
    none = np.empty(0), np.empty((0, model.n_joints))
    own = [
        head_of(recording)
        for recording in recordings
        if isinstance(recording, Recording | RecordingStream)
        and source.startswith(recording.source)
    ]
    if not own:
        return none
    recording = max(own, key=lambda head: len(head.source))
    valid = find_finite_rows(recording.q)
    if not valid.any():
        return none
    logged = recording.t[valid]
    q = recording.q[valid]
    times = t[(t >= logged[0]) & (t <= logged[-1])]
    return times, np.column_stack([np.interp(times, logged, column) for column in q.T])
