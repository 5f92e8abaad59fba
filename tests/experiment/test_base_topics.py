"""State of a floating base from topics of its own, against kinematics of Pinocchio."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description import Frame, RobotModel, load_robot
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, read_recording
from asbuilt.experiment.free_base.base_checks import check_free_base
from asbuilt.experiment.free_base.columns import base_rotations

from .logs.test_mcap import channel, record, written
from .logs.test_ros_logs import START, STATE, Bag
from .test_free_base import URDF, biped, log  # noqa: F401 - fixtures
from .test_inertial_sensor import PLACEMENT, pose, sensed  # noqa: F401 - fixtures

pin = pytest.importorskip("pinocchio")

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
IMU, WRENCH = "sensor_msgs/msg/Imu", "geometry_msgs/msg/WrenchStamped"
MAST = """<link name="mast"/><joint name="mast_fixed" type="fixed"><parent link="trunk"/>
<child link="mast"/><origin xyz=".1 -.2 .3" rpy=".3 -.2 1.2"/></joint></robot>"""
ROWS = np.arange(1.0, 5.0, 0.004)
"""Times of the joint states [s]; those of the base begin before and end after them."""


def configuration(t: float) -> Array:
    """Pose of the trunk and six joints, all of them smooth, as Pinocchio has them."""
    place = np.array([0.3 * np.sin(2.0 * t), 0.2 * np.cos(1.3 * t), 0.4 + 0.05 * np.sin(5.0 * t)])
    angles = [2.5 * t, 0.4 * np.sin(3.0 * t), 0.3 * np.cos(2.0 * t)]
    turn = Rotation.from_euler("ZYX", angles).as_quat()
    return np.concatenate([place, turn, np.sin(t + np.arange(6.0))])


class Walker:
    """The biped with a mast in Pinocchio."""

    def __init__(self) -> None:
        text = URDF.replace("</robot>", MAST).replace('type="continuous"', 'type="revolute"')
        text = text.replace(
            "</joint>", '<limit lower="-9" upper="9" effort="9" velocity="9"/></joint>'
        )
        self.model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        self.data = self.model.createData()

    def frame(self, t: float, name: str) -> tuple[Any, Any]:
        """Placement of a frame in the world, and its twist in its own axes."""
        q, h = configuration(t), 1e-6
        v = pin.difference(self.model, configuration(t - h), configuration(t + h)) / (2.0 * h)
        pin.forwardKinematics(self.model, self.data, q, v)
        pin.updateFramePlacements(self.model, self.data)
        frame = self.model.getFrameId(name)
        twist = pin.getFrameVelocity(self.model, self.data, frame, pin.ReferenceFrame.LOCAL)
        return self.data.oMf[frame].copy(), twist


@pytest.fixture(scope="module")
def walker() -> Walker:
    return Walker()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    file = tmp_path_factory.mktemp("walker") / "walker.urdf"
    file.write_text(URDF.replace("</robot>", MAST))
    return load_robot(file, base="free")


class BaseBag(Bag):
    """A bag with the states of a walking robot."""

    def vector(self, values: Any, kind: str = "Vector3") -> Any:
        axes = "xyzw" if kind == "Quaternion" else "xyz"
        parts = dict(zip(axes, map(float, values), strict=False))
        return self.new(f"geometry_msgs/msg/{kind}", **parts)

    def head(self, at: int, frame: str) -> Any:
        return self.new("std_msgs/msg/Header", stamp=self.time(at), frame_id=frame)

    def pose_of(self, place: Any, quaternion: Any) -> Any:
        position, turn = self.vector(place, "Point"), self.vector(quaternion, "Quaternion")
        return self.new("geometry_msgs/msg/Pose", position=position, orientation=turn)

    def odometry(
        self, at: int, posed: Any, twist: Any, topic: str, frames: tuple[str, str]
    ) -> None:
        none = np.zeros(36)
        twist = self.new(
            "geometry_msgs/msg/Twist", linear=self.vector(twist[:3]), angular=self.vector(twist[3:])
        )
        self.write(
            topic,
            ODOMETRY,
            at,
            header=self.head(at, frames[0]),
            child_frame_id=frames[1],
            pose=self.new("geometry_msgs/msg/PoseWithCovariance", pose=posed, covariance=none),
            twist=self.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )

    def wrench(self, at: int, frame: str, force: Any) -> None:
        wrench = self.new(
            "geometry_msgs/msg/Wrench", force=self.vector(force), torque=self.vector(np.zeros(3))
        )
        self.write(f"/{frame}", WRENCH, at, header=self.head(at, frame), wrench=wrench)

    def joints(self, at: int, names: list[str], q: Any, tau: Any, qd: Any = ()) -> None:
        values = {"position": q, "velocity": qd, "effort": tau}
        arrays = {name: np.array(each, dtype=float) for name, each in values.items()}
        self.write("/joint_states", STATE, at, header=self.head(at, ""), name=names, **arrays)


def clock(t: float) -> int:
    return START + round(t * 1e9)


def write_walk(
    folder: Path,
    walker: Walker,
    *,
    rate: float = 100.0,
    frame: str = "mast",
    frames: tuple[str, str] = ("odom", "robot/mast"),
    topics: tuple[str, ...] = ("/odom",),
    span: tuple[float, float] = (0.5, 5.5),
    change: Callable[[Array], Array] = lambda quaternion: quaternion,
    alone: bool = False,
) -> Path:
    """Write joint states at 250 Hz and the state of a frame, whose clock is another one."""
    names = ["l_a", "l_b", "l_c", "r_a", "r_b", "r_c"]
    with BaseBag(folder) as bag:
        for t in ROWS:
            now, h = configuration(t)[7:], 1e-5
            qd = (configuration(t + h) - configuration(t - h))[7:] / (2.0 * h)
            bag.joints(clock(t), names, now, np.ones(6), qd)
        for t in np.arange(*span, 1.0 / rate) + 0.0013:
            place, twist = walker.frame(t, frame)
            quaternion = change(Rotation.from_matrix(place.rotation).as_quat())
            posed = bag.pose_of(place.translation, quaternion)
            for topic in topics:
                if alone:
                    head = bag.head(clock(t), frames[0])
                    bag.write(topic, POSE, clock(t), header=head, pose=posed)
                else:
                    bag.odometry(clock(t), posed, [*twist.linear, *twist.angular], topic, frames)
    return folder


def compare(found: Recording, walker: Walker, tolerance: float = 1e-6) -> None:
    """Hold the base of a recording against that of Pinocchio at the times of the joint states."""
    R = base_rotations(found.q)
    for k in range(0, found.n_samples, 50):
        place, twist = walker.frame(found.t[k] + ROWS[0], "trunk")
        assert np.abs(found.q[k, :3] - place.translation).max() < tolerance
        assert np.abs(R[k] - place.rotation).max() < tolerance
        if found.qd is not None:
            assert np.abs(R[k].T @ found.qd[k, :3] - twist.linear).max() < 20.0 * tolerance
            rates = found.q[max(k - 1, 0) : k + 2, 3:6], found.t[max(k - 1, 0) : k + 2]
            slope = np.gradient(*rates, axis=0)[min(k, 1)]
            assert np.abs(found.qd[k, 3:6] - slope).max() < (0.1 if k == 0 else 1e-3)


@pytest.mark.parametrize("frame", ["mast", "trunk"])
def test_odometry_of_a_frame_on_the_base_at_times_of_its_own(
    tmp_path: Path, model: RobotModel, walker: Walker, frame: str
) -> None:
    folder = write_walk(tmp_path / "bag", walker, frame=frame, frames=("odom", f"robot/{frame}"))
    sheet = {"columns": {}}
    found = read_recording(folder, model=model, sheet=sheet)
    assert found.n_samples == ROWS.size
    np.testing.assert_allclose(found.q[:, 6:], [configuration(t)[7:] for t in ROWS], atol=1e-9)
    compare(found, walker)
    slower = "/odom has 100 Hz and the joint states 250 Hz: motion above 50 Hz is not in it"
    assert slower in found.notes


def test_a_pose_alone_has_no_rates_and_is_of_the_frame_that_the_sheet_names(
    tmp_path: Path, model: RobotModel, walker: Walker
) -> None:
    folder = write_walk(tmp_path / "bag", walker, alone=True, topics=("/mocap/mast",))
    compare(read_recording(folder, model=model, sheet={"base_frame": "mast"}), walker)
    unmoved = read_recording(folder, model=model)
    assert unmoved.qd is None
    place, _ = walker.frame(ROWS[0], "mast")
    assert np.abs(unmoved.q[0, :3] - place.translation).max() < 1e-6
    (tmp_path / "arm.urdf").write_text(URDF)
    assert read_recording(folder, model=load_robot(tmp_path / "arm.urdf")).q.shape[1] == 6


def test_joint_states_before_and_after_those_of_the_base_are_left_out(
    tmp_path: Path, model: RobotModel, walker: Walker
) -> None:
    found = read_recording(write_walk(tmp_path / "bag", walker, span=(2.0, 4.0)), model=model)
    assert found.n_samples == np.count_nonzero((ROWS > 2.0013) & (ROWS < 3.9913))
    assert any("without a state of the base, before or after it" in each for each in found.notes)


@pytest.mark.parametrize(
    ("given", "said", "sheet"),
    [
        ({"topics": ("/a", "/b")}, r"Odometry on 2 topics \(/a, /b\)", {"base_topic": "/a"}),
        ({"rate": 20.0}, "/odom has 20 Hz and the joint states 250 Hz", None),
        ({"span": (7.5, 9.5)}, "/odom has no value at the time of any joint state", None),
        ({"frames": ("odom", "body")}, "'body' is not fixed to the base", {"base_frame": "mast"}),
        ({"frames": ("odom", "l3")}, "'l3' is not fixed to the base", {"base_frame": "mast"}),
        ({"frames": ("trunk", "mast")}, "in axes of 'trunk', a part of", None),
        ({"change": lambda x: 1.1 * x}, "has length 1.1", None),
        ({"change": lambda x: 0.0 * x}, "has length", None),
    ],
)  # fmt: skip
def test_what_is_wrong_with_odometry_is_one_message(
    tmp_path: Path,
    model: RobotModel,
    walker: Walker,
    given: dict[str, Any],
    said: str,
    sheet: dict[str, str] | None,
) -> None:
    folder = write_walk(tmp_path / "bag", walker, **given)
    with pytest.raises(RecordingError, match=said) as caught:
        read_recording(folder, model=model)
    assert str(caught.value.cure)
    if sheet is not None:
        compare(read_recording(folder, model=model, sheet=sheet), walker)
    with pytest.raises(RecordingError, match="no pose of a base on topic '/other'"):
        read_recording(folder, model=model, sheet={"base_topic": "/other"})


def bag_of(
    columns: dict[str, Array], model: RobotModel, folder: Path, *frames: str, flags: bool = False
) -> Path:
    """Write the columns of a log as topics: joint states, base or sensor, forces or flags.

    Flags are sent when they change.
    """
    t, names = columns["t"], list(model.joint_names[6:])
    unset = np.array([-1.0, *np.zeros(8)])
    with BaseBag(folder) as bag:
        for row, at in enumerate(map(clock, t)):
            now = {name: each[row] for name, each in columns.items()}
            q, tau, qd = ([now[f"{each}_{name}"] for name in names] for each in ("q", "tau", "qd"))
            bag.joints(at, names, q, tau, qd)
            for each in model.contacts:
                closed = columns[f"contact_{each.frame}"]
                if not flags:
                    bag.wrench(at, each.frame, [0.0, 0.0, 30.0 * closed[row]])
                elif row == 0 or closed[row] != closed[row - 1]:
                    topic = f"/contacts/{each.frame}"
                    bag.write(topic, "std_msgs/msg/Bool", at, data=bool(closed[row]))
            parts = {
                each: [now.get(f"{each}{axis}", 0.0) for axis in "xyzw"]
                for each in ("base_", "base_q", "base_v", "base_w", "imu_w", "imu_a", "imu_q")
            }
            if "base_x" in columns:
                posed = bag.pose_of(parts["base_"], parts["base_q"])
                twist = [*parts["base_v"][:3], *parts["base_w"][:3]]
                bag.odometry(at, posed, twist, "/odom", (frames[0], "trunk"))
            else:
                bag.write(
                    "/imu/data",
                    IMU,
                    at,
                    header=bag.head(at, frames[0]),
                    orientation=bag.vector(parts["imu_q"], "Quaternion"),
                    orientation_covariance=unset if "imu_qx" not in columns else np.zeros(9),
                    angular_velocity=bag.vector(parts["imu_w"]),
                    angular_velocity_covariance=unset if "imu_wx" not in columns else np.zeros(9),
                    linear_acceleration=bag.vector(parts["imu_a"]),
                    linear_acceleration_covariance=unset
                    if "imu_ax" not in columns
                    else np.zeros(9),
                )
    return folder


@pytest.mark.parametrize("turned", [True, False])
def test_an_inertial_sensor_and_forces_of_feet_are_those_of_columns(
    tmp_path: Path,
    biped: RobotModel,  # noqa: F811
    sensed: dict[str, Array],  # noqa: F811
    turned: bool,
) -> None:
    box = replace(biped, frames=(*biped.frames, Frame("sensor_box", 5, PLACEMENT)))
    named = replace(biped, frames=(*biped.frames, Frame("imu", 5, PLACEMENT)))
    kept = {name: x for name, x in sensed.items() if turned or not name.startswith("imu_q")}
    folder = bag_of(kept, biped, tmp_path / "bag", "robot/sensor_box")
    found = read_recording(folder, model=box)
    wanted = read_recording(kept, model=named)
    assert any("inertial sensor at sensor_box" in note for note in found.notes)
    # The clock of a bag counts from a date, whose steps have other last digits.
    np.testing.assert_allclose(found.q, wanted.q, atol=2e-5)
    with pytest.raises(RecordingError, match="'robot/sensor_box' is not fixed to the base"):
        read_recording(folder, model=biped)
    stated = read_recording(folder, model=named, sheet={"imu_frame": "imu"})
    np.testing.assert_allclose(stated.q, found.q, atol=1e-12)


def _cycle_quaternion(columns: dict[str, Array]) -> dict[str, Array]:
    """Write w x y z where x y z w are expected."""
    usual, other = "xyzw", "wxyz"
    return columns | {
        f"base_q{own}": columns[f"base_q{axis}"] for own, axis in zip(usual, other, strict=True)
    }


def _turn_velocities(columns: dict[str, Array]) -> dict[str, Array]:
    """Write velocities in axes of the world."""
    turn = Rotation.from_quat(np.stack([columns[f"base_q{axis}"] for axis in "xyzw"], axis=1))
    found = dict(columns)
    for start in ("base_v", "base_w"):
        own = turn.apply(np.stack([columns[f"{start}{axis}"] for axis in "xyz"], axis=1))
        found |= {f"{start}{axis}": own[:, k] for k, axis in enumerate("xyz")}
    return found


@pytest.mark.parametrize(
    ("code", "spoil"),
    [
        ("", dict),
        ("quaternion_order", _cycle_quaternion),
        ("base_velocity_axes", _turn_velocities),
    ],
)
def test_checks_of_the_base_hold_for_topics(
    tmp_path: Path,
    biped: RobotModel,  # noqa: F811
    log: dict[str, Array],  # noqa: F811
    code: str,
    spoil: Callable[[dict[str, Array]], dict[str, Array]],
) -> None:
    columns = spoil(log)
    folder = bag_of(columns, biped, tmp_path / "bag", "map", flags=True)
    of_topics, of_columns = (
        {each.code for each in check_free_base(biped, read_recording(source, model=biped))}
        for source in (folder, columns)
    )
    assert of_topics == of_columns
    contact = [read_recording(source, model=biped).contact for source in (folder, columns)]
    np.testing.assert_array_equal(*contact)
    assert code in (of_topics or {""})


def test_a_sheet_names_columns_of_base_and_contacts(
    tmp_path: Path,
    biped: RobotModel,  # noqa: F811
    log: dict[str, Array],  # noqa: F811
) -> None:
    wanted = read_recording(log, model=biped)
    groups = {
        "base_position": [f"base_{axis}" for axis in "xyz"],
        "base_quaternion": [f"base_q{axis}" for axis in "xyzw"],
        "base_velocity": [f"base_v{axis}" for axis in "xyz"],
        "base_angular_velocity": [f"base_w{axis}" for axis in "xyz"],
    }
    words = {"base_position": "pos", "base_quaternion": "o", "base_velocity": "vel",
             "base_angular_velocity": "omega"}  # fmt: skip
    renamed = {
        usual: f"{words[group]}_{usual[-1]}" for group, names in groups.items() for usual in names
    } | {f"contact_{each.frame}": f"force_{each.frame}" for each in biped.contacts}
    columns = {renamed.get(name, name): values for name, values in log.items()}
    listed = {group: [renamed[name] for name in names] for group, names in groups.items()}
    contact = {each.frame: f"force_{each.frame}" for each in biped.contacts}
    sheet = {"columns": {**listed, "contact": contact}}
    found = read_recording(columns, model=biped, sheet=sheet)
    for name in ("q", "qd", "tau", "contact"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    with pytest.raises(
        ValueError, match="base_position lists 2 columns; list 3, in the order x y z"
    ):
        read_recording(columns, model=biped, sheet={"columns": {"base_position": ["a", "b"]}})
    sheet = {"columns": {"base_position": ["a", "b", "c"]}}
    with pytest.raises(RecordingError, match="gives column 'a' for base_x, which the log does not"):
        read_recording(columns, model=biped, sheet=sheet)


def test_odometry_and_sensors_in_json_and_where_messages_are_missing(
    tmp_path: Path, model: RobotModel, walker: Walker
) -> None:
    names = ["l_a", "l_b", "l_c", "r_a", "r_b", "r_c"]
    body = channel(1, "/joint_states") + channel(2, "/odom") + channel(3, "/imu")

    def add(number: int, t: float, **fields: Any) -> bytes:
        head = struct.pack("<HIQQ", number, 0, clock(t), clock(t))
        stamp = {"sec": clock(t) // 10**9, "nsec": clock(t) % 10**9}
        header = {"stamp": stamp, "frame_id": "odom"}
        return record(5, head + json.dumps({"header": header, **fields}).encode())

    def part(values: Any, axes: str = "xyz") -> dict[str, float]:
        return dict(zip(axes, map(float, values), strict=True))

    for t in ROWS:
        joints = configuration(t)[7:].tolist()
        body += add(1, t, name=names, position=joints, velocity=[0.0] * 6, effort=[1.0] * 6)
    for t in np.arange(0.5, 5.5, 0.008):
        if 2.0 < t < 2.5:
            continue
        place, twist = walker.frame(t, "trunk")
        turn = part(Rotation.from_matrix(place.rotation).as_quat(), "xyzw")
        posed = {"position": part(place.translation), "orientation": turn}
        speeds = {"linear": part(twist.linear), "angular": part(twist.angular)}
        body += add(2, t, child_frame_id="trunk", pose={"pose": posed}, twist={"twist": speeds})
        zero = part(np.zeros(3))
        body += add(3, t, angular_velocity=zero, linear_acceleration=zero, orientation=turn)
    found = read_recording(written(tmp_path / "log.mcap", body), model=model)
    t = found.t + ROWS[0]
    missing = np.isnan(found.q[:, 0])
    np.testing.assert_array_equal(missing, (t > 1.997) & (t < 2.499))
    known = np.flatnonzero(~missing)[::40]
    for k in known[(np.abs(t[known] - 2.25) > 0.5)]:
        place, _ = walker.frame(t[k], "trunk")
        assert np.abs(found.q[k, :3] - place.translation).max() < 1e-6


@pytest.mark.parametrize("parts", ["", "wa"])
def test_a_sensor_that_measures_nothing_is_none(
    tmp_path: Path,
    parts: str,
    biped: RobotModel,  # noqa: F811
    log: dict[str, Array],  # noqa: F811
) -> None:
    kept = {name: x for name, x in log.items() if not name.startswith("base_")}
    unset = {
        f"imu_{part}{axis}": np.full(log["t"].size, np.nan) for part in parts for axis in "xyz"
    }
    folder = bag_of(kept | unset, biped, tmp_path / "bag", "imu_link")
    with pytest.raises(
        RecordingError, match="/imu/data has no value at the time of any joint state"
    ):
        read_recording(folder, model=biped)
