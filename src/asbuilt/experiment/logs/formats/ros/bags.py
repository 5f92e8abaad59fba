"""Recordings in ROS 1 and ROS 2 bags: joint states, and commands of several kinds."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from asbuilt.errors import MissingExtraError, RecordingError
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable
from asbuilt.experiment.logs.formats.ros.joint_table import tabulate_joint_messages
from asbuilt.experiment.logs.formats.ros.messages import JOINT_STATE, KINDS, choose_topics
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.findings import Cure

UNPACKED = 4_000_000_000
"""Bytes that a compressed bag may unpack to."""


def read_ros_bag(
    path: Path,
    *,
    topic: str | None = None,
    command_topic: str | None = None,
    command_joints: Sequence[str] | None = None,
    required: bool = False,
) -> LogTable:
    """Read joints from the folder of a ROS 2 bag, a bare file of one, or a ROS 1 `.bag`.

    A bare file is a `.db3`, also compressed as `.db3.zstd`, or an `.mcap` of ROS 2.

    Times are the message header's if it has one, else the bag's. Measured joints come from
    `sensor_msgs/JointState`, `control_msgs/DynamicJointState` or the state of a trajectory
    controller; commanded positions from `command_topic`, or the only topic that holds some
    (`choose_topics`). `command_joints` names the joints of commands that are numbers alone;
    `required` says that commands which cannot be used are an error even if there are efforts.

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
    read: Callable[[bytes, str], Any] = (
        store.deserialize_ros1 if first_ros else store.deserialize_cdr
    )
    try:
        with _open_bag(path) as bag:
            types = {c.topic: c.msgtype for c in bag.connections if c.msgtype in KINDS}
            if not types:
                raise _without_joints(path, [c.topic for c in bag.connections])
            topics = choose_topics(path, types, topic, command_topic)
            messages: dict[str, list[tuple[int, Any]]] = {}
            for each in {topics.states, topics.commands} - {None}:
                found = [c for c in bag.connections if c.topic == each]
                for connection in found:
                    _define(path, store, connection)
                messages[str(each)] = [
                    (stamp, read(bytes(data), types[str(each)]))
                    for _, stamp, data in bag.messages(found)
                ]
    except (RecordingError, MissingExtraError):
        raise
    except Exception as error:  # rosbags passes on what its readers of databases raise
        kind = "ROS 1" if first_ros else "ROS 2"
        raise RecordingError(
            f"{path} is not a recording: it cannot be read as a {kind} bag"
            f" ({type(error).__name__}: {error})",
            file=str(path),
        ) from error
    return tabulate_joint_messages(
        path, topics, types, messages, command_joints=command_joints, required=required
    )


def _without_joints(path: Path, topics: Sequence[str]) -> RecordingError:
    listing = ", ".join(sorted(set(topics))) or "none"
    return RecordingError(
        f"{path} is not a recording: it holds no {JOINT_STATE} message (topics: {listing})",
        cure=Cure("record the joint states' topic"),
        file=str(path),
    )


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
    """Unpack a file compressed with Zstandard, up to a limit."""
    standard = sys.version_info >= (3, 14)
    zstd = import_module("compression.zstd" if standard else "backports.zstd")
    size = 0
    with zstd.open(packed, "rb") as file, target.open("wb") as out:
        while chunk := file.read(1 << 20):
            size += len(chunk)
            if size > UNPACKED:
                raise RecordingError(
                    f"{packed} unpacks to more than {UNPACKED / 1e9:.0f} GB", file=str(packed)
                )
            out.write(chunk)
    return target


def read_topic_choices(sheet: RecordingSheet) -> dict[str, Any]:
    """Return what a sheet says of the topics, for `read_ros_bag` and `read_mcap`."""
    stated = (sheet.kp, sheet.kd, sheet.command_topic, sheet.command_joints, sheet.columns.command)
    return {
        "topic": sheet.topic,
        "command_topic": sheet.command_topic,
        "command_joints": sheet.command_joints,
        "required": sheet.torque_source == "command" or any(each is not None for each in stated),
    }


FORMATS.register(
    "rosbag",
    LogFormat(
        suffixes=(".db3", ".bag", ".zstd"),
        read=lambda path, sheet: read_isolated(read_ros_bag, path, **read_topic_choices(sheet)),
        folders=True,
    ),
)
