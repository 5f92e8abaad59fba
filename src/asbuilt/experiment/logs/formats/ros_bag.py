"""Recordings in ROS 1 and ROS 2 bags of sensor_msgs/JointState messages."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.errors import MissingExtraError, RecordingError
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable
from asbuilt.experiment.logs.roles import names_command
from asbuilt.findings import Cure

JOINT_STATE = "sensor_msgs/msg/JointState"
_UNPACKED = 4_000_000_000
"""Bytes that a compressed bag may unpack to."""


def read_ros_bag(
    path: Path, *, topic: str | None = None, command_topic: str | None = None
) -> LogTable:
    """Read joint states from the folder of a ROS 2 bag, a bare file of one, or a ROS 1 `.bag`.

    A bare file is a `.db3`, also compressed as `.db3.zstd`, or an `.mcap` of ROS 2.

    Times are the message header's if it has one, else the bag's. Messages that name other joints
    than most (a gripper's) are left out; joints are matched by name in every message. Joint states
    on `command_topic`, or on the only other topic whose name says so, are commanded positions.

    Raises
    ------
    MissingExtraError
        If rosbags is not installed.
    RecordingError
        If the bag cannot be read, has no joint states, or has several topics of them and `topic`
        does not say which, or neither efforts nor commands.
    """
    try:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("rosbags", "bags", f"reading {path}") from error
    first_ros = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first_ros else Stores.ROS2_HUMBLE)
    messages, sent, topics = _messages(path, topic, command_topic)
    if not messages:
        listing = ", ".join(sorted(topics)) or "none"
        raise RecordingError(
            f"{path} is not a recording: it holds no {JOINT_STATE} message (topics: {listing})",
            cure=Cure("record the joint states' topic"),
            file=str(path),
        )
    read: Callable[[bytes, str], Any] = (
        store.deserialize_ros1 if first_ros else store.deserialize_cdr
    )
    states, commands = (
        [(stamp, read(data, JOINT_STATE)) for stamp, data in each] for each in (messages, sent)
    )
    return joint_state_table(path, states, commands)


def joint_state_table(
    path: Path, states: list[tuple[int, Any]], commands: list[tuple[int, Any]]
) -> LogTable:
    """Return joint states, with the times [ns] at which they were logged, as a table.

    The command at the time of a state is the last one sent until then. Raises `RecordingError` if
    there is neither an effort nor a command.
    """
    names = _usual_names(states)
    kept = _naming(states, names)
    of_commands = set(_usual_names(commands)) if commands else set[str]()
    commanded = tuple(name for name in names if name in of_commands)
    commands = _naming(commands, commanded) if commanded else []
    stamps, sent = _clocks(kept, commands)
    known: dict[str, tuple[str, str]] = {}
    columns: dict[str, Array] = {"time": (stamps - stamps[0]).astype(np.float64) * 1e-9}
    for field, quantity in (
        ("position", "position"),
        ("velocity", "velocity"),
        ("effort", "torque"),
    ):
        values = _values(kept, field, names)
        if values is None:
            continue
        for k, name in enumerate(names):
            columns[f"{name}/{field}"] = np.ascontiguousarray(values[:, k])
            known[f"{name}/{field}"] = (quantity, name)
    notes = []
    values = _values(commands, "position", commanded) if commands else None
    if values is not None:
        last = np.searchsorted(sent, stamps, side="right") - 1
        if before := int(np.count_nonzero(last < 0)):
            notes.append(f"{before} states before the first command count as commanded like it")
        for k, name in enumerate(commanded):
            columns[f"{name}/command"] = np.ascontiguousarray(values[np.maximum(last, 0), k])
            known[f"{name}/command"] = ("command", name)
    if not any(quantity in ("torque", "command") for quantity, _ in known.values()):
        raise RecordingError(
            f"{path}: the joint states of {', '.join(names)} have no effort, and no topic holds"
            " their commands; torques, currents or commanded positions are required",
            cure=Cure('name the topic of the commands in a recording sheet: command_topic = "..."'),
            file=str(path),
        )
    if dropped := len(states) - len(kept):
        notes.append(f"{dropped} of {len(states)} messages name other joints and were left out")
    return LogTable(source=str(path), columns=columns, known=known, notes=tuple(notes))


def _messages(
    path: Path, topic: str | None, command_topic: str | None
) -> tuple[list[tuple[int, bytes]], list[tuple[int, bytes]], dict[str, int]]:
    """Return the joint states and the commands with their times of logging, and all topics."""
    try:
        with _opened(path) as bag:
            topics = {c.topic: c.msgcount for c in bag.connections}
            found = [c for c in bag.connections if c.msgtype == JOINT_STATE]
            chosen = chosen_topics(path, {c.topic for c in found}, topic, command_topic)
            messages, sent = (
                [
                    (stamp, bytes(data))
                    for _, stamp, data in bag.messages([c for c in found if c.topic == each])
                ]
                if each is not None
                else []
                for each in chosen
            )
    except RecordingError:
        raise
    except Exception as error:  # rosbags passes on what its readers of databases raise
        kind = "ROS 1" if path.suffix == ".bag" else "ROS 2"
        raise RecordingError(
            f"{path} is not a recording: it cannot be read as a {kind} bag"
            f" ({type(error).__name__}: {error})",
            file=str(path),
        ) from error
    return messages, sent, topics


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag by its suffix; a compressed file is unpacked to a temporary one."""
    from rosbags.rosbag1 import Reader as FirstReader  # noqa: PLC0415
    from rosbags.rosbag2 import Reader  # noqa: PLC0415

    with tempfile.TemporaryDirectory(prefix="asbuilt-") as folder:
        storage = _storage(path)
        if storage.suffix == ".zstd":
            storage = _unpacked(storage, Path(folder) / storage.stem)
        with FirstReader(storage) if storage.suffix == ".bag" else Reader(storage) as bag:
            yield bag


def _storage(path: Path) -> Path:
    """Return the bag, or the only file of a folder without its list."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return path
    files = sorted(
        each for kind in ("*.db3", "*.db3.zstd", "*.mcap", "*.bag") for each in path.glob(kind)
    )
    if len(files) != 1:
        cure = (
            "give one of them" if files else "give the file of a recording, or the folder of a bag"
        )
        raise RecordingError(
            f"{path} is no ROS bag: it has no metadata.yaml and {len(files)} files .db3,"
            " .db3.zstd, .mcap or .bag",
            cure=Cure(cure),
            file=str(path),
        )
    return files[0]


def _unpacked(packed: Path, target: Path) -> Path:
    """Unpack a file compressed with Zstandard, up to a limit."""
    standard = sys.version_info >= (3, 14)
    zstd = import_module("compression.zstd" if standard else "backports.zstd")
    size = 0
    with zstd.open(packed, "rb") as file, target.open("wb") as out:
        while chunk := file.read(1 << 20):
            size += len(chunk)
            if size > _UNPACKED:
                raise RecordingError(
                    f"{packed} unpacks to more than {_UNPACKED / 1e9:.0f} GB", file=str(packed)
                )
            out.write(chunk)
    return target


def chosen_topics(
    path: Path, topics: set[str], topic: str | None, command_topic: str | None
) -> tuple[str | None, str | None]:
    """Return the topics of the joint states and of their commands among those that have some.

    A topic whose name says command, desired, target or the like holds commands. Raises
    `RecordingError` if it is not clear which topic holds the states, or one does not exist.
    """
    for each in (topic, command_topic):
        if each is not None and each not in topics:
            raise RecordingError(
                f"{path} has no joint states on topic {each!r}; it has them on"
                f" {', '.join(sorted(topics)) or 'no topic'}",
                file=str(path),
                value=each,
                available=sorted(topics),
            )
    states = {each for each in topics if each != command_topic and not names_command(each)}
    if topic is not None:
        chosen: str | None = topic
    elif "/joint_states" in states:
        chosen = "/joint_states"
    else:
        chosen = next(iter(states or topics), None)
        if len(states or topics) > 1:
            raise RecordingError(
                f"{path} has joint states on {len(topics)} topics ({', '.join(sorted(topics))})",
                cure=Cure('choose one in a recording sheet: topic = "..."'),
                file=str(path),
                available=sorted(topics),
            )
    if command_topic is None:
        named = [each for each in topics if each != chosen and names_command(each)]
        command_topic = named[0] if len(named) == 1 else None
    return chosen, command_topic


def _naming(states: list[tuple[int, Any]], names: Sequence[str]) -> list[tuple[int, Any]]:
    """Return the messages that name all of these joints."""
    return [(stamp, state) for stamp, state in states if set(names) <= set(state.name)]


def _usual_names(states: list[tuple[int, Any]]) -> tuple[str, ...]:
    """Return the joints of the most frequent kind of message that carries efforts."""
    votes: dict[tuple[str, ...], int] = {}
    for _, state in states:
        weight = 1000 if len(state.effort) == len(state.name) > 0 else 1
        key = tuple(sorted(state.name))
        votes[key] = votes.get(key, 0) + weight
    best = max(votes, key=lambda key: (votes[key], len(key)))
    return tuple(next(state.name for _, state in states if tuple(sorted(state.name)) == best))


def _clocks(
    states: list[tuple[int, Any]], commands: list[tuple[int, Any]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the times [ns] of states and commands by one clock.

    It is that of the headers, unless one of them has none.
    """
    groups = [each for each in (states, commands) if each]
    stamped = [np.array([_stamp(state) for _, state in each], dtype=np.int64) for each in groups]
    if any(len(np.unique(each)) < max(2, len(each) // 2) for each in stamped):
        stamped = [np.array([stamp for stamp, _ in each], dtype=np.int64) for each in groups]
    return stamped[0], stamped[1] if commands else np.empty(0, dtype=np.int64)


def _stamp(state: Any) -> int:
    return int(state.header.stamp.sec) * 1_000_000_000 + int(state.header.stamp.nanosec)


def _values(states: list[tuple[int, Any]], field: str, names: tuple[str, ...]) -> Array | None:
    values = np.full((len(states), len(names)), np.nan)
    order: dict[tuple[str, ...], list[int]] = {}
    for row, (_, state) in enumerate(states):
        logged = getattr(state, field)
        if len(logged) != len(state.name):
            continue
        key = tuple(state.name)
        if key not in order:
            order[key] = [key.index(name) for name in names]
        values[row] = logged[order[key]]
    return None if np.all(np.isnan(values)) else values


FORMATS.register(
    "rosbag",
    LogFormat(
        suffixes=(".db3", ".bag", ".zstd"),
        read=lambda path, sheet: read_isolated(
            read_ros_bag, path, topic=sheet.topic, command_topic=sheet.command_topic
        ),
        folders=True,
    ),
)
