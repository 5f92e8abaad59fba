"""Recordings in MCAP files: joint states of ROS 2 (CDR), or messages in JSON."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import MissingExtraError, RecordingError, refuse
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable
from asbuilt.experiment.logs.formats.ros.bags import read_ros_bag, read_topic_choices
from asbuilt.experiment.logs.formats.ros.joint_table import tabulate_joint_messages
from asbuilt.experiment.logs.formats.ros.messages import (
    ARRAY,
    CONTROLLER_STATE,
    DYNAMIC_STATE,
    JOINT_STATE,
    KINDS,
    TRAJECTORY,
    choose_topics,
)
from asbuilt.findings import Cure

MOST = 1 << 30
"""Bytes of a single record, compressed or not; chunks are a few MB."""


@dataclass(frozen=True, slots=True)
class Channel:
    """Hold the topic of messages, how they are encoded, and the name of their schema."""

    topic: str
    encoding: str
    schema: str


class McapRecords:
    """Read a file record by record; `channels` fills on the way, `complete` says how it ended."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.complete = False

    def messages(self) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, time of logging [ns] and content of every message.

        Raises
        ------
        RecordingError
            If the file is no MCAP file, or a record is damaged.
        MissingExtraError
            If mcap is not installed.
        """
        try:
            from mcap import exceptions, records  # noqa: PLC0415
        except ImportError as error:
            raise MissingExtraError("mcap", "bags", f"reading {self.path}") from error
        schemas: dict[int, str] = {}
        with self.path.open("rb") as file:
            try:
                for record in self._records(file):
                    if isinstance(record, records.Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, records.Channel):
                        schema = schemas.get(record.schema_id, "")
                        self.channels[record.id] = Channel(
                            record.topic, record.message_encoding, schema
                        )
                    elif isinstance(record, records.Message) and record.channel_id in self.channels:
                        yield self.channels[record.channel_id], record.log_time, record.data
            except RecordingError:
                raise
            except (exceptions.EndOfFile, struct.error) as error:
                # A record ends early where the file does: a recorder that was switched off.
                if file.read(1) or not self.channels:
                    raise self._damaged(f"{type(error).__name__}: {error}") from None
            except Exception as error:  # lz4 and zstandard raise exceptions of their own
                raise self._damaged(f"{type(error).__name__}: {error}") from error

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        """Yield records, the records of chunks in their place, until the end of the data."""
        from mcap.records import Chunk, DataEnd  # noqa: PLC0415
        from mcap.stream_reader import StreamReader, breakup_chunk  # noqa: PLC0415

        for record in StreamReader(file, emit_chunks=True, record_size_limit=MOST).records:
            if isinstance(record, DataEnd):
                self.complete = True
                return
            if not isinstance(record, Chunk):
                yield record
                continue
            if record.uncompressed_size > MOST:
                raise self._damaged(f"a chunk unpacks to {record.uncompressed_size} bytes")
            if record.compression not in ("", "lz4", "zstd"):
                raise self._damaged(
                    f"chunks are compressed as {record.compression!r}; known are lz4 and zstd"
                )
            yield from breakup_chunk(record, validate_crc=True)

    def _damaged(self, why: str) -> RecordingError:
        return RecordingError(
            f"{self.path} is not a recording: it cannot be read as MCAP ({why})",
            file=str(self.path),
        )


NAMES = ("name", "names", "joint_names")
SECONDS, NANOSECONDS = ("sec", "secs"), ("nanosec", "nsec", "nsecs")
TIMES = ("stamp", "time_from_start")
SHAPES = MappingProxyType(
    {
        DYNAMIC_STATE: {"joint_names", "interface_values"},
        CONTROLLER_STATE: {"joint_names", "error"},
        TRAJECTORY: {"joint_names", "points"},
        ARRAY: {"layout", "data"},
    }
)
"""Fields by which messages in JSON are recognised."""
DEEPEST = 8
"""Objects within objects that fields are looked for in."""


def read_mcap(
    path: Path,
    *,
    topic: str | None = None,
    command_topic: str | None = None,
    command_joints: Sequence[str] | None = None,
    required: bool = False,
) -> LogTable:
    """Read joints as `read_ros_bag` does, or messages in JSON, from an MCAP file.

    JSON messages are joint states (`name`, `position`, `velocity`, `effort`), lists of joints
    (`joints` with `name`, `position`, ... each, as `foxglove.JointStates`), the other messages that
    `read_ros_bag` reads, or objects whose numbers and lists of numbers become columns such as
    `q_1`. A file that was cut off is read as far as it goes.

    Raises
    ------
    RecordingError
        If the file cannot be read, has no such message, or has several topics of them and `topic`
        does not say which.
    MissingExtraError
        If what unpacks it, or reads messages of ROS 2, is not installed.
    """
    records = McapRecords(path)
    found: dict[str, list[tuple[int, bytes]]] = {}
    of_ros: set[str] = set()
    options: dict[str, Any] = {
        "topic": topic,
        "command_topic": command_topic,
        "command_joints": command_joints,
        "required": required,
    }
    for channel, stamp, content in records.messages():
        if channel.encoding == "json":
            found.setdefault(channel.topic, []).append((stamp, content))
        elif _holds_states(channel):
            of_ros.add(channel.topic)
    if of_ros and (topic is None or topic in of_ros):
        return read_ros_bag(path, **options)
    if not found:
        others = sorted({f"{c.topic} ({c.encoding})" for c in records.channels.values()})
        raise RecordingError(
            f"{path} is not a recording: it holds no {JOINT_STATE} and no message in JSON (topics:"
            f" {', '.join(others) or 'none'})",
            cure=Cure("record the joint states' topic"),
            file=str(path),
        )
    parsed = {each: _parse_messages(path, each, found[each]) for each in found}
    table = _build_table(path, parsed, **options)
    if records.complete:
        return table
    note = f"the file is cut off after {table.n_samples} messages"
    return LogTable(table.source, table.columns, True, table.text_columns, table.known,
                    (*table.notes, note))  # fmt: skip


def _holds_states(channel: Channel) -> bool:
    kind = KINDS.get(channel.schema)
    return channel.encoding == "cdr" and kind is not None and kind.states is not None


def _parse_messages(
    path: Path, topic: str, messages: Sequence[tuple[int, bytes]]
) -> list[tuple[int, Any]]:
    """Return the objects of a topic with their times of logging [ns]."""
    objects: list[tuple[int, Any]] = []
    for number, (stamp, content) in enumerate(messages):
        try:
            parsed = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise RecordingError(
                f"{path}: message {number + 1} of {topic} is not JSON ({str(error)[:80]})",
                file=str(path),
                value=number + 1,
            ) from None
        if isinstance(parsed, Mapping):
            objects.append((stamp, parsed))
    return objects


def _build_table(
    path: Path,
    topics: Mapping[str, list[tuple[int, Any]]],
    *,
    topic: str | None,
    command_topic: str | None,
    **options: Any,
) -> LogTable:
    types: dict[str, str] = {}
    messages: dict[str, list[tuple[int, Any]]] = {}
    for name, objects in topics.items():
        kinds = [
            (stamp, found) for stamp, each in objects if (found := _read_ros_message(stamp, each))
        ]
        if kinds:
            types[name] = kinds[0][1][0]
            messages[name] = [(at, each) for at, (kind, each) in kinds if kind == types[name]]
    states = {name for name, kind in types.items() if KINDS[kind].states}
    if states and (topic is None or topic in states):
        chosen = choose_topics(path, types, topic, command_topic)
        return tabulate_joint_messages(path, chosen, types, messages, **options)
    choice = Cure('choose one in a recording sheet: topic = "..."')
    refuse(
        RecordingError,
        (
            topic is None and len(topics) > 1,
            f"{path} has messages in JSON on {len(topics)} topics ({', '.join(sorted(topics))})",
            {"cure": choice, "file": str(path), "available": sorted(topics)},
        ),
        (
            topic is not None and topic not in topics,
            f"{path} has no messages in JSON on topic {topic!r}; it has them on"
            f" {', '.join(sorted(topics))}",
            {"file": str(path), "value": topic, "available": sorted(topics)},
        ),
    )
    return _build_columns(path, topics[topic or next(iter(topics))])


def _read_ros_message(logged: int, message: Mapping[str, Any]) -> tuple[str, Any] | None:
    """Return the type of ROS that a message in JSON has, and the message; None if it has none."""
    state = _read_joint_state(logged, message)
    if state is not None:
        return JOINT_STATE, state
    kind = next((kind for kind, fields in SHAPES.items() if fields <= set(message)), None)
    if kind is None:
        return None
    message = {"header": {}, **message}
    found = _with_fields(message)
    try:
        (KINDS[kind].commands or KINDS[kind].states)(logged, found)  # type: ignore[misc]
    except (AttributeError, TypeError, ValueError, KeyError):
        return None
    return kind, found


def _with_fields(value: Any, name: str = "", depth: int = 0) -> Any:
    """Return a JSON value with objects as attributes, and times as ROS names their parts."""
    if isinstance(value, Mapping) and (name in TIMES or {*SECONDS} & set(value)):
        return _read_time(value, 0)
    if isinstance(value, Mapping) and depth < DEEPEST:
        parts = {**({"stamp": {}} if name == "header" else {}), **value}
        fields = {str(key): _with_fields(each, str(key), depth + 1) for key, each in parts.items()}
        return SimpleNamespace(**fields)
    if isinstance(value, list) and depth < DEEPEST:
        return [_with_fields(each, "", depth + 1) for each in value]
    return value


def _read_joint_state(logged: int, message: Mapping[str, Any]) -> Any:
    """Return a message as a joint state, None if it is none."""
    joints = message.get("joints")
    if isinstance(joints, list) and joints and all(isinstance(each, Mapping) for each in joints):
        message = {**message, "name": [each.get("name") for each in joints]} | {
            field: [each.get(field) for each in joints]
            for field in ("position", "velocity", "effort")
            if all(each.get(field) is not None for each in joints)
        }
    names = next((message[key] for key in NAMES if key in message), None)
    if not isinstance(names, list) or not all(isinstance(each, str) for each in names):
        return None
    position = _read_numbers(message.get("position"))
    if position.size != len(names) or not names:
        return None
    header = message.get("header")
    stamp = header.get("stamp") if isinstance(header, Mapping) else message.get("timestamp")
    return SimpleNamespace(
        header=SimpleNamespace(stamp=_read_time(stamp, logged)),
        name=tuple(names),
        position=position,
        velocity=_read_numbers(message.get("velocity")),
        effort=_read_numbers(message.get("effort", message.get("torque"))),
    )


def _read_time(stamp: Any, otherwise: int) -> Any:
    """Return seconds and nanoseconds of a time, or of another [ns] if it is none."""
    if isinstance(stamp, Mapping):
        whole = next((stamp[key] for key in SECONDS if key in stamp), None)
        rest = next((stamp[key] for key in NANOSECONDS if key in stamp), 0)
        if isinstance(whole, int) and isinstance(rest, int):
            return SimpleNamespace(sec=whole, nanosec=rest)
    if isinstance(stamp, int | float) and not isinstance(stamp, bool) and np.isfinite(stamp):
        nanoseconds = round(stamp * 1e9)
    else:
        nanoseconds = otherwise
    return SimpleNamespace(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def _read_numbers(values: Any) -> Array:
    """Return a list of numbers (null: NaN), empty for anything else."""
    if not isinstance(values, list) or not all(
        value is None or (isinstance(value, int | float) and not isinstance(value, bool))
        for value in values
    ):
        return np.empty(0)
    try:
        return np.array([np.nan if value is None else float(value) for value in values])
    except OverflowError:
        return np.empty(0)


def _build_columns(path: Path, objects: Sequence[tuple[int, Any]]) -> LogTable:
    """Return the numbers of messages as columns; messages of another shape are left out."""
    flat = [(stamp, dict(_list_fields(each))) for stamp, each in objects]
    shapes = [
        tuple(sorted((name, values.size) for name, values in each.items())) for _, each in flat
    ]
    usual = max(set(shapes), key=shapes.count) if shapes else ()
    kept = [row for row, shape in zip(flat, shapes, strict=True) if shape == usual]
    if not usual:
        raise RecordingError(
            f"{path} is not a recording: its messages in JSON hold no numbers", file=str(path)
        )
    logged = np.array([stamp for stamp, _ in kept], dtype=np.int64)
    columns: dict[str, Array] = {"time": (logged - logged[0]).astype(np.float64) * 1e-9}
    for name, size in usual:
        values = np.array([each[name] for _, each in kept])
        if size == 1:
            columns[name] = values[:, 0]
        else:
            columns |= {f"{name}_{k + 1}": values[:, k].copy() for k in range(size)}
    left_out = len(flat) - len(kept)
    notes = (f"{left_out} of {len(flat)} messages have other fields and were left out",)
    return LogTable(source=str(path), columns=columns, notes=notes if left_out else ())


def _list_fields(value: Any, name: str = "", depth: int = 0) -> list[tuple[str, Array]]:
    """Return names and numbers of the fields of an object, fields of inner ones as outer/inner."""
    if isinstance(value, Mapping) and depth < DEEPEST:
        return [
            found
            for key, inner in value.items()
            for found in _list_fields(inner, f"{name}/{key}" if name else str(key), depth + 1)
        ]
    numbers = _read_numbers(value if isinstance(value, list) else [value])
    return [(name, numbers)] if name and numbers.size and value is not None else []


FORMATS.register(
    "mcap",
    LogFormat(
        suffixes=(".mcap",),
        read=lambda path, sheet: read_isolated(read_mcap, path, **read_topic_choices(sheet)),
    ),
)
