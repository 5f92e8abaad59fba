"""Recordings in MCAP files: joint states of ROS 2 (CDR), or messages in JSON."""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    isolate,
    tabulate_variables,
)
from asbuilt.experiment.logs.formats.ros.bags import read_ros_bag
from asbuilt.experiment.logs.formats.ros.joint_table import tabulate_joint_messages
from asbuilt.experiment.logs.formats.ros.messages import (
    ARRAY,
    CONTROLLER_STATE,
    DYNAMIC_STATE,
    IMU,
    JOINT_STATE,
    KINDS,
    ODOMETRY,
    POSE,
    TRAJECTORY,
    WRENCH,
    choose_topics,
)
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.findings import Cure
from asbuilt.isolated_reading import FileKind

MOST = 1 << 30
"""Bytes of a single record, compressed or not; chunks are a few MB."""
NAMES = ("name", "names", "joint_names")
SECONDS = ("sec", "secs")
NANOSECONDS = ("nanosec", "nsec", "nsecs")
NUMBERS = {int, float, type(None)}
"""Types of JSON that are numbers: null is a missing one, and true is none."""
SHAPES = MappingProxyType(
    {
        JOINT_STATE: {"name", "position"},
        DYNAMIC_STATE: {"joint_names", "interface_values"},
        CONTROLLER_STATE: {"joint_names", "error"},
        TRAJECTORY: {"joint_names", "points"},
        ARRAY: {"layout", "data"},
        ODOMETRY: {"pose", "twist", "child_frame_id"},
        IMU: {"angular_velocity", "linear_acceleration"},
        WRENCH: {"header", "wrench"},
        POSE: {"header", "pose"},
    }
)
"""Fields by which messages in JSON are recognised."""


def read_mcap(path: Path, sheet: RecordingSheet) -> LogTable:
    """Read joints as `read_ros_bag` does, or messages in JSON, from an MCAP file.

    JSON messages are joint states (`name`, `position`, `velocity`, `effort`), lists of joints
    (`joints` with `name`, `position`, ... each, as `foxglove.JointStates`), the other messages that
    `read_ros_bag` reads, or objects whose numbers and lists of numbers become columns such as
    `q_1`. A file that was cut off is read as far as it goes.

    Raises
    ------
    RecordingError
        If the file has no such message, or has several topics of them and the sheet does not say
        which.
    """
    from mcap.exceptions import EndOfFile  # noqa: PLC0415
    from mcap.records import Channel, Message, Schema  # noqa: PLC0415

    schemas = dict[int, str]()
    channels = dict[int, Channel]()
    found = dict[str, list[tuple[int, Any]]]()
    of_ros = set[str]()
    complete = True
    with path.open("rb") as file:
        try:
            for record in _list_records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message) and record.channel_id in channels:
                    channel = channels[record.channel_id]
                    kind = KINDS.get(schemas.get(channel.schema_id, ""), {})
                    if channel.message_encoding == "json":
                        topic = found.setdefault(channel.topic, [])
                        topic.append(
                            (record.log_time, _parse(record.data, len(topic), path, channel))
                        )
                    elif channel.message_encoding == "cdr" and "states" in kind:
                        of_ros.add(channel.topic)
        except (EndOfFile, struct.error):
            # A record ends early where the file does: a recorder that was switched off.
            if file.read(1) or not channels:
                raise
            complete = False
    if of_ros and sheet.topic in (None, *of_ros):
        return read_ros_bag(path, sheet)
    if not found:
        others = sorted({f"{c.topic} ({c.message_encoding})" for c in channels.values()})
        raise RecordingError(
            f"{path} is not a recording: it holds no {JOINT_STATE} and no message in JSON (topics:"
            f" {', '.join(others) or 'none'})",
            cure=Cure("record the joint states' topic"),
            file=str(path),
        )
    table = _tabulate_objects(path, found, sheet)
    note = f"the file is cut off after {table.n_samples} messages"
    return table if complete else replace(table, notes=(*table.notes, note))


def _list_records(file: BinaryIO) -> Iterator[Any]:
    """Yield records, the records of chunks in their place, until the end of the data."""
    from mcap.records import Chunk, DataEnd  # noqa: PLC0415
    from mcap.stream_reader import StreamReader, breakup_chunk  # noqa: PLC0415

    for record in StreamReader(file, emit_chunks=True, record_size_limit=MOST).records:
        if isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            size = record.uncompressed_size
            packed = record.compression
            if size > MOST:
                raise ValueError(f"a chunk unpacks to {size} bytes")
            if packed not in ("", "lz4", "zstd"):
                raise ValueError(f"chunks are compressed as {packed!r}; known are lz4 and zstd")
        yield from breakup_chunk(record, True) if isinstance(record, Chunk) else (record,)


def _parse(content: bytes, before: int, path: Path, channel: Any) -> Any:
    """Return a value of JSON, objects with their fields as attributes."""
    try:
        return json.loads(content, object_hook=_make_object)
    except (ValueError, RecursionError) as error:
        raise RecordingError(
            f"{path}: message {before + 1} of {channel.topic} is not JSON ({str(error)[:80]})",
            file=str(path),
            value=before + 1,
        ) from None


def _make_object(fields: dict[str, Any]) -> SimpleNamespace:
    """Return an object of JSON; one that is a time has the names that ROS gives its parts."""
    if whole := [fields[key] for key in SECONDS if key in fields]:
        parts = [fields[key] for key in NANOSECONDS if key in fields]
        fields |= {"sec": whole[0], "nanosec": parts[0] if parts else 0}
    return SimpleNamespace(**fields)


def _tabulate_objects(
    path: Path, topics: Mapping[str, list[tuple[int, Any]]], sheet: RecordingSheet
) -> LogTable:
    """Return the joints of messages as ROS has them, or else the numbers of a topic."""
    types: dict[str, str] = {}
    messages: dict[str, list[tuple[int, Any]]] = {}
    for name, objects in topics.items():
        for stamp, each in objects:
            kind, message = _read_as_ros(stamp, each)
            if kind and types.setdefault(name, kind) == kind:
                messages.setdefault(name, []).append((stamp, message))
    states = [name for name, kind in types.items() if "states" in KINDS[kind]]
    if states and sheet.topic in (None, *states):
        return tabulate_joint_messages(choose_topics(path, types, sheet), messages, sheet)
    topic = sheet.topic or next(iter(topics))
    listed = ", ".join(sorted(topics))
    choice = Cure('choose one in a recording sheet: topic = "..."')
    if sheet.topic is None and len(topics) > 1:
        raise RecordingError(
            f"{path} has messages in JSON on {len(topics)} topics ({listed})",
            cure=choice,
            file=str(path),
            available=sorted(topics),
        )
    if topic not in topics:
        raise RecordingError(
            f"{path} has no messages in JSON on topic {topic!r}; it has them on {listed}",
            file=str(path),
            value=topic,
            available=sorted(topics),
        )
    return _tabulate_numbers(path, topics[topic])


def _read_as_ros(logged: int, message: Any) -> tuple[str, Any]:
    """Return the type of ROS that a message in JSON has, and the message; "" if it has none."""
    given = vars(message) if isinstance(message, SimpleNamespace) else {}
    fields = {key: value for key, value in given.items() if value is not None}
    joints = fields.get("joints")
    if isinstance(joints, list) and all(isinstance(joint, SimpleNamespace) for joint in joints):
        lists = {
            key: [getattr(joint, key, None) for joint in joints]
            for key in ("name", "position", "velocity", "effort")
        }
        fields |= {key: values for key, values in lists.items() if None not in values}
    names = next((fields[key] for key in NAMES if key in fields), None)
    fields |= {"name": names, "effort": fields.get("effort", fields.get("torque", ()))}
    kind = next((kind for kind, known in SHAPES.items() if known <= fields.keys()), "")
    readers = KINDS.get(kind, {})
    read = readers.get("commands", readers.get("states", readers.get("base")))
    with suppress(AttributeError, TypeError, ValueError, KeyError, OverflowError):
        for each in read(logged, SimpleNamespace(**fields)) if read else ():
            named = kind == ARRAY or each.position.size == len(each.names) > 0
            if named and all(isinstance(name, str) for name in each.names):
                return kind, SimpleNamespace(**fields)
    return "", None


def _tabulate_numbers(path: Path, objects: Sequence[tuple[int, Any]]) -> LogTable:
    """Return the numbers of messages as columns; messages of another shape are left out."""
    flat = [(stamp, dict(_list_fields(each))) for stamp, each in objects]
    shapes = [tuple((name, each[name].size) for name in sorted(each)) for _, each in flat]
    usual = Counter(shapes).most_common(1)[0][0] if shapes else ()
    kept = [row for row, shape in zip(flat, shapes, strict=True) if shape == usual]
    if not usual or len(kept) < 2:
        raise RecordingError(
            f"{path} is not a recording: its messages in JSON hold no numbers, or there is one",
            file=str(path),
        )
    logged = np.array([stamp for stamp, _ in kept], dtype=np.int64)
    variables = {name: np.array([each[name] for _, each in kept]) for name, _ in usual}
    t = (logged - logged[0]).astype(np.float64) * 1e-9
    table = tabulate_variables(str(path), {"time": t, **variables})
    left_out = len(flat) - len(kept)
    notes = (f"{left_out} of {len(flat)} messages have other fields and were left out",)
    return replace(table, notes=notes if left_out else ())


def _list_fields(value: Any, name: str = "") -> Iterator[tuple[str, Array]]:
    """Yield names and numbers of the fields of an object, fields of inner ones as outer/inner."""
    if isinstance(value, SimpleNamespace):
        for key, inner in vars(value).items():
            yield from _list_fields(inner, f"{name}/{key}" if name else key)
        return
    numbers = value if isinstance(value, list) else [value]
    if name and numbers and value is not None and {*map(type, numbers)} <= NUMBERS:
        with suppress(OverflowError):
            yield (
                name,
                np.array([np.nan if number is None else float(number) for number in numbers]),
            )


FORMATS.register(
    "mcap",
    LogFormat(
        suffixes=(".mcap",),
        read=isolate(read_mcap, FileKind("MCAP", extra="bags"), by_sheet=True),
    ),
)
