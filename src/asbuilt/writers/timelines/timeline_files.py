"""Timelines as MCAP, for Foxglove and PlotJuggler, and for rerun with the moving robot.

In MCAP each torque is a topic of `sensor_msgs/msg/JointState` with the torque as effort; positions
are one too. Events are `rcl_interfaces/msg/Log`.
"""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.appearance import link_solids
from asbuilt.description.model import ROOT
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MissingExtraError
from asbuilt.findings import Severity
from asbuilt.writers.files import atomic_write
from asbuilt.writers.pictures.skeleton import round_mesh
from asbuilt.writers.timelines.timeline import Timeline, Track

STATE, LOG = "sensor_msgs/msg/JointState", "rcl_interfaces/msg/Log"
LEVELS: dict[Severity, int] = {"info": 20, "warning": 30, "error": 40}
"""Levels of `rcl_interfaces/msg/Log`."""


def write_mcap(path: str | os.PathLike[str], timelines: Sequence[Timeline]) -> Path:
    """Write timelines as one MCAP file; several recordings have topics of their own.

    Times are those of the recordings, from the first on if that is negative.

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
    writer = Writer(stream)
    writer.start(profile="ros2", library="asbuilt")
    messages = _Messages(writer, get_typestore(Stores.ROS2_HUMBLE))
    for timeline in timelines:
        name = "".join(c if c.isalnum() else "_" for c in timeline.name)
        messages.add(timeline, f"/{name}" if len(timelines) > 1 else "")
    messages.finish()
    return atomic_write(path, stream.getvalue())


class _Messages:
    """Messages of a file, with the definitions of their types."""

    def __init__(self, writer: Any, store: Any) -> None:
        self.writer, self.types = writer, store
        self.written: list[tuple[int, int, bytes]] = []
        self.schemas = {
            name: writer.register_schema(
                name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode()
            )
            for name in (STATE, LOG)
        }

    def add(self, timeline: Timeline, prefix: str) -> None:
        """Add a timeline, topic by topic."""
        begin = min(timeline.start, 0.0)
        names = list(timeline.model.joint_names)
        for track in timeline.tracks:
            channel = self._channel(f"{prefix}/{track.name}", STATE)
            for time, joints, torque in _samples(track, names):
                self._message(channel, STATE, time - begin, name=joints, effort=torque)
        channel = self._channel(f"{prefix}/position", STATE)
        for time, q in zip(timeline.t.tolist(), timeline.q, strict=True):
            self._message(channel, STATE, time - begin, name=names, position=q)
        channel = self._channel(f"{prefix}/events", LOG)
        for mark in timeline.marks:
            self._message(
                channel, LOG, mark.time - begin, level=LEVELS[mark.severity], msg=mark.text
            )

    def _channel(self, topic: str, kind: str) -> int:
        return int(self.writer.register_channel(topic, "cdr", self.schemas[kind]))

    def _message(self, channel: int, kind: str, time: float, **fields: Any) -> None:
        nanoseconds = round(time * 1e9)
        stamp = self.types.types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
        if kind == STATE:
            empty = np.empty(0)
            header = self.types.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            given = {"position": empty, "velocity": empty, "effort": empty} | fields
            message = self.types.types[kind](header=header, **given)
        else:
            message = self.types.types[kind](
                stamp=stamp, name="asbuilt", file="", function="", line=0, **fields
            )
        data = bytes(self.types.serialize_cdr(message, kind))
        self.written.append((nanoseconds, channel, data))

    def finish(self) -> None:
        """Write the messages in the order of time, in which viewers read them."""
        for nanoseconds, channel, data in sorted(self.written, key=lambda each: each[0]):
            self.writer.add_message(channel, nanoseconds, data, nanoseconds)
        self.writer.finish()


def _samples(track: Track, names: list[str]) -> Iterator[tuple[float, list[str], Array]]:
    """Yield time, joints and their torques, of one joint each where it has times of its own."""
    if not track.has_own_times:
        for time, torque in zip(track.t.tolist(), track.torque, strict=True):
            yield time, names, np.ascontiguousarray(torque)
        return
    for k, name in enumerate(names):
        for time, value in zip(*(each.tolist() for each in track.joint(k)), strict=True):
            yield time, [name], np.array([value])


TIME = "time"
RERUN_LEVELS: dict[Severity, str] = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
TRACK_COLOURS: dict[str, tuple[int, int, int]] = {
    "measured": (0, 114, 178),
    "as_built": (213, 94, 0),
    "cad": (125, 131, 140),
    "error": (0, 158, 115),
    "external": (0, 158, 115),
    "threshold": (179, 38, 30),
}
"""Colours of the report."""
ROD, HOUSING = (205, 208, 213), (226, 122, 32)


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
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "timeline.rrd"
        stream = rerun.RecordingStream("asbuilt", recording_id="asbuilt")
        stream.save(file)
        for timeline in timelines:
            name = "".join(c if c.isalnum() else "_" for c in timeline.name)
            _write_timeline(rerun, stream, timeline, [name] if len(timelines) > 1 else [])
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
            columns = rerun.Scalars.columns(scalars=torque[valid])
            stream.send_columns(rerun.new_entity_path(place), [_times(rerun, t[valid])], columns)
    if timeline.marks:
        texts = rerun.TextLog.columns(
            text=[mark.text for mark in timeline.marks],
            level=[RERUN_LEVELS[mark.severity] for mark in timeline.marks],
        )
        times = np.array([mark.time for mark in timeline.marks])
        stream.send_columns(
            rerun.new_entity_path([*above, "events"]), [_times(rerun, times)], texts
        )


def _write_robot(rerun: Any, stream: Any, timeline: Timeline, place: list[str]) -> None:
    """Write the bodies of the links once, and their poses over time."""
    model = timeline.model
    links = [[*place, f"{k + 1} {link.name}"] for k, link in enumerate(model.links)]
    for number, solid in enumerate(link_solids(model)):
        parent = place if solid.link == ROOT else links[solid.link]
        vertices, faces = round_mesh(solid)
        colour = ROD if solid.kind == "rod" else HOUSING
        mesh = rerun.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=colour)
        stream.log([*parent, f"{solid.kind} {number}"], mesh, static=True)
    if not len(timeline.t):
        return
    poses = link_poses(model, timeline.q)
    for k, link in enumerate(links):
        columns = rerun.Transform3D.columns(
            translation=poses[:, k, :3, 3], mat3x3=poses[:, k, :3, :3]
        )
        stream.send_columns(rerun.new_entity_path(link), [_times(rerun, timeline.t)], columns)


def _times(rerun: Any, t: Array) -> Any:
    return rerun.TimeColumn(TIME, duration=t)
