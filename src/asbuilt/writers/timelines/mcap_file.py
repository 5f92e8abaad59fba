"""Timelines as MCAP: joint states and log messages of ROS 2, which Foxglove and PlotJuggler open.

Each torque is a topic of `sensor_msgs/msg/JointState` with the torque as effort; the measured one
has the positions too. Events are `rcl_interfaces/msg/Log`.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import MissingExtraError
from asbuilt.findings import Severity
from asbuilt.writers.files import atomic_write
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
