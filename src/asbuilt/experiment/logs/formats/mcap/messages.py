"""Recordings in MCAP files: joint states of ROS 2 (CDR), or messages in JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable
from asbuilt.experiment.logs.formats.mcap.records import Channel, McapRecords
from asbuilt.experiment.logs.formats.ros_bag import (
    JOINT_STATE,
    chosen_topics,
    joint_state_table,
    read_ros_bag,
)
from asbuilt.findings import Cure

NAMES = ("name", "names", "joint_names")
SECONDS, NANOSECONDS = ("sec", "secs"), ("nanosec", "nsec", "nsecs")
DEEPEST = 8
"""Objects within objects that fields are looked for in."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Hold a time in seconds and nanoseconds."""

    sec: int
    nanosec: int


@dataclass(frozen=True, slots=True)
class Header:
    """Hold the time of a message."""

    stamp: Stamp


@dataclass(frozen=True, slots=True)
class JointState:
    """Hold the fields of a joint state, as `sensor_msgs/JointState` names them."""

    header: Header
    name: tuple[str, ...]
    position: Array
    velocity: Array
    effort: Array


def read_mcap(
    path: Path, *, topic: str | None = None, command_topic: str | None = None
) -> LogTable:
    """Read joint states of ROS 2, or messages in JSON, from an MCAP file.

    JSON messages are joint states (`name`, `position`, `velocity`, `effort`), lists of joints
    (`joints` with `name`, `position`, ... each, as `foxglove.JointStates`), or objects whose
    numbers and lists of numbers become columns such as `q_1`. Joint states on `command_topic`, or
    on the only other topic whose name says so, are commanded positions. A file that was cut off is
    read as far as it goes.

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
    for channel, stamp, content in records.messages():
        if channel.encoding == "json":
            found.setdefault(channel.topic, []).append((stamp, content))
        elif _is_joint_state(channel):
            of_ros.add(channel.topic)
    if of_ros and (topic is None or topic in of_ros):
        return read_ros_bag(path, topic=topic, command_topic=command_topic)
    if not found:
        others = sorted({f"{c.topic} ({c.encoding})" for c in records.channels.values()})
        raise RecordingError(
            f"{path} is not a recording: it holds no {JOINT_STATE} and no message in JSON (topics:"
            f" {', '.join(others) or 'none'})",
            cure=Cure("record the joint states' topic"),
            file=str(path),
        )
    parsed = {each: _parsed(path, each, found[each]) for each in found}
    table = _table(path, parsed, topic, command_topic)
    if records.complete:
        return table
    note = f"the file is cut off after {table.n_samples} messages"
    return LogTable(table.source, table.columns, True, table.text_columns, table.known,
                    (*table.notes, note))  # fmt: skip


def _is_joint_state(channel: Channel) -> bool:
    return channel.encoding == "cdr" and channel.schema == JOINT_STATE


def _parsed(path: Path, topic: str, messages: Sequence[tuple[int, bytes]]) -> list[tuple[int, Any]]:
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


def _table(
    path: Path,
    topics: Mapping[str, list[tuple[int, Any]]],
    topic: str | None,
    command_topic: str | None,
) -> LogTable:
    states = {
        name: [(stamp, state) for stamp, each in objects if (state := _state(stamp, each))]
        for name, objects in topics.items()
    }
    joint_states = {name for name, each in states.items() if each}
    if joint_states and (topic is None or topic in joint_states):
        chosen, commands = chosen_topics(path, joint_states, topic, command_topic)
        return joint_state_table(path, states[str(chosen)], states[commands] if commands else [])
    if topic is None and len(topics) > 1:
        raise RecordingError(
            f"{path} has messages in JSON on {len(topics)} topics ({', '.join(sorted(topics))})",
            cure=Cure('choose one in a recording sheet: topic = "..."'),
            file=str(path),
            available=sorted(topics),
        )
    if topic is not None and topic not in topics:
        raise RecordingError(
            f"{path} has no messages in JSON on topic {topic!r}; it has them on"
            f" {', '.join(sorted(topics))}",
            file=str(path),
            value=topic,
            available=sorted(topics),
        )
    return _columns(path, topics[topic or next(iter(topics))])


def _state(logged: int, message: Mapping[str, Any]) -> JointState | None:
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
    position = _numbers(message.get("position"))
    if position.size != len(names) or not names:
        return None
    header = message.get("header")
    stamp = header.get("stamp") if isinstance(header, Mapping) else message.get("timestamp")
    return JointState(
        Header(_stamp(stamp, logged)),
        tuple(names),
        position,
        _numbers(message.get("velocity")),
        _numbers(message.get("effort", message.get("torque"))),
    )


def _stamp(stamp: Any, logged: int) -> Stamp:
    """Return the time of a message: its own, else that of logging [ns]."""
    if isinstance(stamp, Mapping):
        whole = next((stamp[key] for key in SECONDS if key in stamp), None)
        rest = next((stamp[key] for key in NANOSECONDS if key in stamp), 0)
        if isinstance(whole, int) and isinstance(rest, int):
            return Stamp(whole, rest)
    if isinstance(stamp, int | float) and not isinstance(stamp, bool) and np.isfinite(stamp):
        nanoseconds = round(stamp * 1e9)
        return Stamp(nanoseconds // 10**9, nanoseconds % 10**9)
    return Stamp(logged // 10**9, logged % 10**9)


def _numbers(values: Any) -> Array:
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


def _columns(path: Path, objects: Sequence[tuple[int, Any]]) -> LogTable:
    """Return the numbers of messages as columns; messages of another shape are left out."""
    flat = [(stamp, dict(_fields(each))) for stamp, each in objects]
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


def _fields(value: Any, name: str = "", depth: int = 0) -> list[tuple[str, Array]]:
    """Return names and numbers of the fields of an object, those of inner ones as outer/inner."""
    if isinstance(value, Mapping) and depth < DEEPEST:
        return [
            found
            for key, inner in value.items()
            for found in _fields(inner, f"{name}/{key}" if name else str(key), depth + 1)
        ]
    numbers = _numbers(value if isinstance(value, list) else [value])
    return [(name, numbers)] if name and numbers.size and value is not None else []


FORMATS.register(
    "mcap",
    LogFormat(
        suffixes=(".mcap",),
        read=lambda path, sheet: read_isolated(
            read_mcap, path, topic=sheet.topic, command_topic=sheet.command_topic
        ),
    ),
)
