"""Logs of ROS beside the usual bag: echoed messages, compressed databases, bags of ROS 1."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.ros_bag import chosen_topics
from asbuilt.experiment.logs.readers import read_recording

JOINTS = ("base", "elbow", "wrist")
STATE = "sensor_msgs/msg/JointState"


@pytest.fixture
def motion() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    t = np.arange(300) / 100.0
    return {"t": t} | {name: rng.normal(size=(300, 3)) for name in ("q", "qd", "tau")}


def same(path: Path, motion: dict[str, np.ndarray], velocity: bool = True) -> None:
    recording = read_recording(path).reordered(JOINTS)
    np.testing.assert_allclose(recording.t, motion["t"], atol=1e-9)
    np.testing.assert_array_equal(recording.q, motion["q"])
    np.testing.assert_array_equal(recording.tau, motion["tau"])
    assert (recording.qd is not None) == velocity


@pytest.mark.parametrize("velocity", [True, False])
def test_echoed_messages_in_any_order_of_joints(
    tmp_path: Path, motion: dict[str, np.ndarray], velocity: bool
) -> None:
    lines = []
    for row, t in enumerate(motion["t"]):
        order = np.roll([0, 1, 2], row)
        arrays = [
            ",".join(map(repr, motion[name][row, order].tolist()))
            if velocity or name != "qd"
            else ""
            for name in ("q", "qd", "tau")
        ]
        nanoseconds = round(t * 1e9)
        stamp = f"{1_700_000_000 + nanoseconds // 10**9},{nanoseconds % 10**9},world"
        lines.append(",".join([stamp, *(JOINTS[k] for k in order), *arrays]))
    path = tmp_path / "echo.csv"
    path.write_text("\n".join(lines) + "\n")
    same(path, motion, velocity)
    path.write_text("\n".join([*lines, "1,2,world,base"]))
    with pytest.raises(RecordingError, match="line 301: it is not a joint state"):
        read_recording(path)


def states(store: Any, motion: dict[str, np.ndarray]) -> Any:
    """Yield the time [ns] and the message of every row."""
    state, header, time = (
        store.types[name] for name in (STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    for row, t in enumerate(motion["t"]):
        nanoseconds = round(t * 1e9)
        stamp = time(sec=1_700_000_000 + nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        head = header(seq=row, stamp=stamp, frame_id="") if store.first else header(stamp, "")
        values = [np.ascontiguousarray(motion[name][row]) for name in ("q", "qd", "tau")]
        yield 1_700_000_000 * 10**9 + nanoseconds, state(head, list(JOINTS), *values)


class Store:
    """A store of types that says whether it is that of ROS 1."""

    def __init__(self, first: bool) -> None:
        stores = pytest.importorskip("rosbags.typesys")
        kind = stores.Stores.ROS1_NOETIC if first else stores.Stores.ROS2_HUMBLE
        self.store, self.types, self.first = stores.get_typestore(kind), {}, first
        self.types = self.store.types


def test_bag_of_ros_1(tmp_path: Path, motion: dict[str, np.ndarray]) -> None:
    store = Store(first=True)
    writer = import_module("rosbags.rosbag1").Writer
    with writer(tmp_path / "run.bag") as bag:
        connection = bag.add_connection("/joint_states", STATE, typestore=store.store)
        for stamp, message in states(store, motion):
            bag.write(connection, stamp, store.store.serialize_ros1(message, STATE))
    same(tmp_path / "run.bag", motion)
    (tmp_path / "cut.bag").write_bytes((tmp_path / "run.bag").read_bytes()[:2000])
    with pytest.raises(RecordingError, match=r"cut\.bag"):
        read_recording(tmp_path / "cut.bag")


def test_compressed_database_without_its_list(
    tmp_path: Path, motion: dict[str, np.ndarray]
) -> None:
    store = Store(first=False)
    module = import_module("rosbags.rosbag2")
    with module.Writer(tmp_path / "bag", version=9) as bag:
        connection = bag.add_connection("/joint_states", STATE, typestore=store.store)
        for stamp, message in states(store, motion):
            bag.write(connection, stamp, store.store.serialize_cdr(message, STATE))
    zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    database = next((tmp_path / "bag").glob("*.db3"))
    packed = tmp_path / "run.db3.zstd"
    packed.write_bytes(zstd.compress(database.read_bytes()))
    same(packed, motion)
    packed.write_bytes(packed.read_bytes()[:500])
    with pytest.raises(RecordingError, match=r"run\.db3\.zstd"):
        read_recording(packed)


def with_commands(
    folder: Path, motion: dict[str, np.ndarray], topics: tuple[str, str], stamped: bool
) -> Path:
    """Write joint states without effort, and 4 ms before each the position of the next.

    Commands name their joints in another order, and no gripper.
    """
    store = Store(first=False)
    state, header, time = (
        store.types[name] for name in (STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    none = np.zeros(0)
    with import_module("rosbags.rosbag2").Writer(folder, version=9) as bag:
        of_states, of_commands = (
            bag.add_connection(each, STATE, typestore=store.store) for each in topics
        )
        for row, (stamp, _) in enumerate(states(store, motion)):
            q, ahead = motion["q"][row], motion["q"][min(row + 1, 299), ::-1]
            for connection, at, names, values in (
                (of_commands, stamp - 4_000_000, JOINTS[::-1], ahead),
                (of_states, stamp, (*JOINTS, "gripper"), np.append(q, 0.5)),
            ):
                own = at if stamped or connection is of_states else 0
                head = header(time(sec=own // 10**9, nanosec=own % 10**9), "")
                message = state(head, list(names), np.ascontiguousarray(values), none, none)
                bag.write(connection, at, store.store.serialize_cdr(message, STATE))
    return folder


@pytest.mark.parametrize("stamped", [True, False])
def test_commands_on_a_topic_of_their_own(
    tmp_path: Path, motion: dict[str, np.ndarray], stamped: bool
) -> None:
    folder = with_commands(tmp_path / "a", motion, ("/state", "/joint_commands"), stamped)
    recording = read_recording(folder, kp=2.0)
    assert recording.joint_names == JOINTS
    assert "joints without a command were left out: gripper" in recording.notes
    np.testing.assert_array_equal(recording.q, motion["q"])
    np.testing.assert_array_equal(recording.command[:-1], motion["q"][1:])


def test_topics_of_states_and_commands(tmp_path: Path) -> None:
    def chosen(*topics: str, topic: str | None = None, command: str | None = None) -> Any:
        return chosen_topics(tmp_path, set(topics), topic, command)

    assert chosen() == (None, None)
    assert chosen("/robot/cmd") == ("/robot/cmd", None)
    assert chosen("/measured", "/desired") == ("/measured", "/desired")
    assert chosen("/joint_states", "/leader", "/arm/goal") == ("/joint_states", "/arm/goal")
    assert chosen("/joint_states", "/a/cmd", "/b/cmd") == ("/joint_states", None)
    assert chosen("/a", "/b", command="/a") == ("/b", "/a")
    with pytest.raises(RecordingError, match=r"2 topics \(/leader, /measured\)"):
        chosen("/measured", "/leader")
    with pytest.raises(RecordingError, match="no joint states on topic '/follower'"):
        chosen("/measured", "/leader", topic="/measured", command="/follower")
