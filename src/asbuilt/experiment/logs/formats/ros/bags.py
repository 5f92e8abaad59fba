"""Recordings in ROS 1 and ROS 2 bags: joint states, and commands of several kinds."""

from __future__ import annotations

import contextlib
import shutil
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable, isolate
from asbuilt.experiment.logs.formats.ros.joint_table import tabulate_joint_messages
from asbuilt.experiment.logs.formats.ros.messages import (
    JOINT_STATE,
    KINDS,
    choose_topics,
)
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.findings import Cure
from asbuilt.isolated_reading import FileKind

READ = (".db3", ".mcap", ".zstd", ".bag", ".yaml")
"""Suffixes of the files of a bag."""


def read_ros_bag(path: Path, sheet: RecordingSheet) -> LogTable:
    """Read joints from the folder of a ROS 2 bag, a bare file of one, or a ROS 1 `.bag`.

    A bare file is a `.db3`, also compressed as `.db3.zstd`, or an `.mcap` of ROS 2.

    Times are the message header's if it has one, else the bag's. Measured joints come from
    `sensor_msgs/JointState`, `control_msgs/DynamicJointState` or the state of a trajectory
    controller; commanded positions from `command_topic`, or the only topic that holds some
    (`choose_topics`).

    Raises
    ------
    RecordingError
        If the bag has no joint states, or has several topics of them and the sheet does not say
        which, or neither efforts nor commands.
    """
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    first_ros = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first_ros else Stores.ROS2_HUMBLE)
    read = store.deserialize_ros1 if first_ros else store.deserialize_cdr
    messages: dict[str, list[tuple[int, Any]]] = {}
    with _open_bag(path) as bag:
        types = {
            connection.topic: connection.msgtype
            for connection in bag.connections
            if connection.msgtype in KINDS
        }
        if not types:
            listing = (
                ", ".join(sorted({connection.topic for connection in bag.connections})) or "none"
            )
            raise RecordingError(
                f"{path} is not a recording: it holds no {JOINT_STATE} message (topics: {listing})",
                cure=Cure("record the joint states' topic"),
                file=str(path),
            )
        topics = choose_topics(path, types, sheet)
        used = {topics.states, topics.commands, *topics.base}
        wanted = [connection for connection in bag.connections if connection.topic in used]
        for connection in wanted:
            _define(path, store, connection)
            messages.setdefault(connection.topic, [])
        for connection, stamp, data in bag.messages(wanted) if wanted else ():
            messages[connection.topic].append((stamp, read(bytes(data), connection.msgtype)))
    return tabulate_joint_messages(topics, messages, sheet)


def _define(path: Path, store: Any, connection: Any) -> None:
    """Add the definition that the bag gives of a type which rosbags does not know.

    Raises `RecordingError` if it gives none, as databases before ROS 2 Iron.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg  # noqa: PLC0415

    if connection.msgtype in store.fielddefs:
        return
    definition = connection.msgdef
    if not definition.data:
        raise RecordingError(
            f"{path} does not define the messages of {connection.topic} ({connection.msgtype})",
            cure=Cure("record, or convert, with definitions: ros2 bag record --storage mcap"),
            file=str(path),
            value=connection.topic,
        )
    types = (
        get_types_from_idl(definition.data)
        if definition.format.name == "IDL"
        else get_types_from_msg(definition.data, connection.msgtype)
    )
    store.register({name: each for name, each in types.items() if name not in store.fielddefs})


@contextlib.contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    """Open a bag by its suffix; a compressed file is unpacked to a temporary one."""
    from rosbags.rosbag1 import Reader as FirstReader  # noqa: PLC0415
    from rosbags.rosbag2 import Reader  # noqa: PLC0415

    with tempfile.TemporaryDirectory(prefix="asbuilt-") as folder:
        storage = _find_storage(path)
        if storage.suffix == ".zstd":
            storage = _unpack(storage, Path(folder) / storage.stem)
        with FirstReader(storage) if storage.suffix == ".bag" else Reader(storage) as bag:
            yield bag


def _find_storage(path: Path) -> Path:
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


def _unpack(packed: Path, target: Path) -> Path:
    """Unpack a file compressed with Zstandard; the process has a limit of what it may write."""
    zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    with zstd.open(packed, "rb") as file, target.open("wb") as out:
        shutil.copyfileobj(file, out)
    return target


FORMATS.register(
    "rosbag",
    LogFormat(
        suffixes=(".db3", ".zstd"),
        read=isolate(
            read_ros_bag, FileKind("a ROS 2 bag", extra="bags", reads=READ), by_sheet=True
        ),
        folders=True,
    ),
)
FORMATS.register(
    "rosbag1",
    LogFormat(
        suffixes=(".bag",),
        read=isolate(read_ros_bag, FileKind("a ROS 1 bag", extra="bags"), by_sheet=True),
    ),
)
