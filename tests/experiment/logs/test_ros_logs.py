"""Logs of ROS beside the usual bag: echoed messages, compressed databases, bags of ROS 1."""

from __future__ import annotations

import sqlite3
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment import RecordingSheet, read_recording
from asbuilt.experiment.logs.formats.ros.bags import read_ros_bag
from asbuilt.experiment.logs.formats.ros.messages import (
    ARRAY,
    CONTROLLER_STATE,
    DYNAMIC_STATE,
    TRAJECTORY,
    choose_topics,
)

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
        types = {each.split()[0]: each.partition(" ")[2] or STATE for each in topics}
        sheet = RecordingSheet(topic=topic, command_topic=command)
        found = choose_topics(tmp_path, types, sheet)
        return found.states, found.commands

    assert chosen() == (None, None)
    assert chosen("/robot/cmd") == ("/robot/cmd", None)
    assert chosen("/measured", "/desired") == ("/measured", "/desired")
    assert chosen("/joint_states", "/leader", "/arm/goal") == ("/joint_states", "/arm/goal")
    assert chosen("/joint_states", "/a/cmd", "/b/cmd") == ("/joint_states", None)
    assert chosen("/a", "/b", command="/a") == ("/b", "/a")
    with pytest.raises(RecordingError, match=r"2 topics \(/leader, /measured\)"):
        chosen("/measured", "/leader")
    with pytest.raises(RecordingError, match="no joint states on topic '/follower'"):
        chosen("/measured", "/leader", topic="/follower")
    with pytest.raises(RecordingError, match="commands of joints on topic '/follower'"):
        chosen("/measured", "/leader", topic="/measured", command="/follower")
    arm = ("/joint_states", f"/arm/commands {ARRAY}", f"/arm/joint_trajectory {TRAJECTORY}")
    assert chosen(*arm[:2]) == ("/joint_states", "/arm/commands")
    assert chosen(*arm) == ("/joint_states", None)
    assert chosen(*arm, f"/arm/state {CONTROLLER_STATE}") == ("/joint_states", "/arm/state")
    assert chosen(f"/arm/state {CONTROLLER_STATE}") == ("/arm/state", "/arm/state")
    assert chosen(arm[0], f"/effort_controller/commands {ARRAY}") == (arm[0], None)
    assert chosen(arm[0], f"/numbers {ARRAY}") == (arm[0], None)
    assert chosen(f"/dynamic_joint_states {DYNAMIC_STATE}") == ("/dynamic_joint_states", None)


DEFINITIONS = {
    CONTROLLER_STATE: """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
trajectory_msgs/JointTrajectoryPoint error
""",
    DYNAMIC_STATE: """std_msgs/Header header
string[] joint_names
control_msgs/InterfaceValue[] interface_values
================================================================================
MSG: control_msgs/InterfaceValue
string[] interface_names
float64[] values
""",
}
"""Of control_msgs, as short as they may be."""


class Bag:
    """A bag of ROS 2 that a test fills with messages of several types."""

    def __init__(self, folder: Path, storage: str = "MCAP", version: int = 9) -> None:
        self.store, self.folder = Store(first=False).store, folder
        typesys = import_module("rosbags.typesys")
        for kind, definition in DEFINITIONS.items():
            types = typesys.get_types_from_msg(definition, kind)
            new = {name: each for name, each in types.items() if name not in self.store.fielddefs}
            self.store.register(new)
        plugin = import_module("rosbags.rosbag2.enums").StoragePlugin[storage]
        module = import_module("rosbags.rosbag2")
        self.writer = module.Writer(folder, version=version, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> Bag:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def new(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def time(self, nanoseconds: int, kind: str = "Time") -> Any:
        parts = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        return self.new(f"builtin_interfaces/msg/{kind}", **parts)

    def header(self, stamp: int) -> Any:
        return self.new("std_msgs/msg/Header", stamp=self.time(stamp), frame_id="")

    def point(self, positions: Any, after: int = 0, velocities: Any = ()) -> Any:
        return self.new(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=np.array(positions, dtype=float),
            velocities=np.array(velocities, dtype=float),
            accelerations=np.zeros(0),
            effort=np.zeros(0),
            time_from_start=self.time(after, "Duration"),
        )

    def write(self, topic: str, kind: str, at: int, **fields: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        data = self.store.serialize_cdr(self.new(kind, **fields), kind)
        self.writer.write(self.connections[topic], at, data)

    def state(self, at: int, q: Any, effort: Any = ()) -> None:
        self.write(
            "/joint_states",
            STATE,
            at,
            header=self.header(at),
            name=list(JOINTS),
            position=np.array(q, dtype=float),
            velocity=np.zeros(0),
            effort=np.array(effort, dtype=float),
        )

    def numbers(self, at: int, values: Any, topic: str = "/position_controller/commands") -> None:
        layout = self.new("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        self.write(topic, ARRAY, at, layout=layout, data=np.array(values, dtype=float))

    def trajectory(self, at: int, points: Any, stamp: int = 0) -> None:
        """Write a trajectory of points (time after its start, positions in reversed order)."""
        self.write(
            "/arm_controller/joint_trajectory",
            TRAJECTORY,
            at,
            header=self.header(stamp),
            joint_names=list(JOINTS[::-1]),
            points=[self.point(q, after) for after, q in points],
        )


START, STEP = 1_700_000_000 * 10**9, 10_000_000


def moments(motion: dict[str, np.ndarray]) -> Any:
    """Yield the time [ns], the positions and the positions of the next row."""
    q = motion["q"]
    for row in range(300):
        yield START + row * STEP, q[row], q[min(row + 1, 299)]


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_numbers_without_names_need_the_names_of_their_joints(
    tmp_path: Path, motion: dict[str, np.ndarray], storage: str
) -> None:
    with Bag(tmp_path / "bag", storage) as bag:
        for at, now, ahead in moments(motion):
            bag.numbers(at - STEP // 2, ahead[[2, 0, 1]])
            bag.state(at, now)
    with pytest.raises(RecordingError, match="3 numbers without the names") as caught:
        read_ros_bag(bag.folder, RecordingSheet())
    assert "command_joints" in str(caught.value.cure)
    order = {"command_joints": [JOINTS[2], JOINTS[0], JOINTS[1]]}
    recording = read_recording(bag.folder, sheet=order, kp=2.0)
    np.testing.assert_array_equal(recording.command[:-1], motion["q"][1:])
    for wrong, said in (
        (["base", "elbow"], "lists 2 command_joints"),
        (["base", "base", "elbow"], "lists 2 command_joints"),
        (["base", "elbow", "hand"], "name base, elbow, hand"),
    ):
        with pytest.raises(RecordingError, match=said):
            read_ros_bag(bag.folder, RecordingSheet(command_joints=wrong))


def test_commands_that_cannot_be_used_are_left_out_beside_efforts_unless_they_are_asked_for(
    tmp_path: Path, motion: dict[str, np.ndarray]
) -> None:
    with Bag(tmp_path / "bag") as bag:
        for at, now, ahead in moments(motion):
            bag.numbers(at - STEP // 2, ahead)
            bag.state(at, now, now)
    recording = read_recording(bag.folder)
    assert recording.command is None
    assert any("commands were left out: " in note for note in recording.notes)
    with pytest.raises(RecordingError, match="without the names"):
        read_ros_bag(bag.folder, RecordingSheet(torque_source="command"))
    for said in ({"torque_source": "command"}, {"kp": 2.0}):
        assert RecordingSheet.model_validate(said).names_commands
    assert not RecordingSheet().names_commands


@pytest.mark.parametrize("stamped", [True, False])
def test_points_of_trajectories_hold_from_their_times(
    tmp_path: Path, motion: dict[str, np.ndarray], stamped: bool
) -> None:
    with Bag(tmp_path / "bag") as bag:
        for row, (at, now, ahead) in enumerate(moments(motion)):
            start, q = at - STEP // 2, motion["q"][:, ::-1]
            if row < 100:
                bag.trajectory(start, [(0, ahead[::-1])], start if stamped else 0)
            elif row % 20 == 0:
                # the last of these points is that of the next trajectory, which replaces it
                points = [(k * STEP, q[min(row + 1 + k, 299)]) for k in range(20)]
                points.append((20 * STEP, np.full(3, 9.0)))
                bag.trajectory(start, points, start if stamped else 0)
            bag.state(at, now)
    recording = read_recording(bag.folder, kp=2.0)
    assert recording.joint_names == JOINTS
    np.testing.assert_array_equal(recording.command[:-1], motion["q"][1:])


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([(0, 0.0), (20 * STEP, 1.0)], r"come 0\.2 s after the one before, and the states"),
        ([(4 * STEP, 1.0)], "were replaced by the next trajectory"),
    ],
)
def test_trajectories_whose_way_the_controller_chose_are_refused(
    tmp_path: Path, motion: dict[str, np.ndarray], points: Any, said: str
) -> None:
    with Bag(tmp_path / "bag") as bag:
        for at, now, _ in moments(motion):
            bag.trajectory(at, [(after, [value] * 3) for after, value in points])
            bag.state(at, now)
    with pytest.raises(RecordingError, match=said) as caught:
        read_ros_bag(bag.folder, RecordingSheet())
    assert "controller_state" in str(caught.value.cure)


def controller_states(bag: Bag, motion: dict[str, np.ndarray]) -> Path:
    with bag:
        for at, now, ahead in moments(motion):
            reference, feedback = bag.point(ahead), bag.point(now, velocities=2.0 * now)
            bag.write(
                "/arm_controller/controller_state",
                CONTROLLER_STATE,
                at,
                header=bag.header(at),
                joint_names=list(JOINTS),
                reference=reference,
                feedback=feedback,
                error=reference,
            )
    return bag.folder


def test_a_controllers_state_holds_both(tmp_path: Path, motion: dict[str, np.ndarray]) -> None:
    recording = read_recording(controller_states(Bag(tmp_path / "bag"), motion), kp=2.0)
    np.testing.assert_array_equal(recording.q, motion["q"])
    np.testing.assert_array_equal(recording.qd, 2.0 * motion["q"])
    np.testing.assert_array_equal(recording.command[:-1], motion["q"][1:])


def test_messages_that_a_bag_does_not_define_are_named(
    tmp_path: Path, motion: dict[str, np.ndarray]
) -> None:
    older = controller_states(Bag(tmp_path / "bag", "SQLITE3", version=8), motion)
    with sqlite3.connect(next(older.glob("*.db3"))) as database:
        database.execute("DROP TABLE IF EXISTS message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    with pytest.raises(RecordingError, match="does not define the messages of /arm_controller"):
        read_ros_bag(older, RecordingSheet())


def test_interfaces_of_joints_are_states(tmp_path: Path, motion: dict[str, np.ndarray]) -> None:
    with Bag(tmp_path / "bag") as bag:
        for at, now, _ in moments(motion):
            kind, fields = "control_msgs/msg/InterfaceValue", ["effort", "position"]
            values = [
                bag.new(kind, interface_names=fields, values=np.array([2.0 * each, each]))
                for each in now
            ]
            values.append(bag.new(kind, interface_names=["force.x"], values=np.zeros(1)))
            bag.write(
                "/dynamic_joint_states",
                DYNAMIC_STATE,
                at,
                header=bag.header(at),
                joint_names=[*JOINTS, "sensor"],
                interface_values=values,
            )
    recording = read_recording(bag.folder)
    assert recording.joint_names == JOINTS
    np.testing.assert_array_equal(recording.q, motion["q"])
    np.testing.assert_array_equal(recording.tau, 2.0 * motion["q"])
