"""Logs of robot learning: archives of PyTorch, folders of SAGE and LeRobot."""

import io
import json
import pickle
import tomllib
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl
import pytest

from asbuilt.description import load_robot
from asbuilt.errors import DescriptionError, RecordingError
from asbuilt.experiment import read_fitted_recordings, read_recording
from asbuilt.experiment.logs.reading_options import parse_servo_numbers

SHARED = Path(__file__).parents[3].parent / "shared"


class FloatStorage:
    """Storage under the name that PyTorch gives it."""


def rebuild(*arguments):
    raise AssertionError("not called here")


class Tensor:
    def __init__(self, key, array):
        self.key, self.array = key, array

    def __reduce__(self):
        strides = tuple(step // self.array.itemsize for step in self.array.strides)
        storage = Stored(self.key, self.array.size)
        return rebuild, (storage, 0, self.array.shape, strides, False, OrderedDict())


class Stored:
    def __init__(self, key, size):
        self.pid = ("storage", FloatStorage, key, "cpu", size)


FloatStorage.__module__, FloatStorage.__qualname__ = "torch", "FloatStorage"
rebuild.__module__, rebuild.__qualname__ = "torch._utils", "_rebuild_tensor_v2"


class Pickler(pickle._Pickler):
    """Write what torch.save writes, without looking the names up."""

    def persistent_id(self, item):
        return item.pid if isinstance(item, Stored) else None

    def save_global(self, item, name=None):
        self.write(b"c" + f"{item.__module__}\n{item.__qualname__}\n".encode())
        self.memoize(item)

    dispatch: ClassVar = {**pickle._Pickler.dispatch, type(rebuild): save_global, type: save_global}


def archive(path, content, arrays):
    text = io.BytesIO()
    Pickler(text, protocol=2).dump(content)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("log/data.pkl", text.getvalue())
        file.writestr("log/byteorder", "little")
        for key, array in arrays.items():
            file.writestr(f"log/data/{key}", array.astype("<f4").tobytes())
    return path


def test_tensors_are_read_without_pytorch(tmp_path):
    t = np.arange(50, dtype="f4") * 0.01
    q = np.random.default_rng(1).normal(size=(50, 2)).astype("f4")
    arrays = {"0": t, "1": q, "2": q + 1}
    content = {
        "time": Tensor("0", t),
        "dof_pos": Tensor("1", q),
        "des_dof_pos": Tensor("2", q),
    }
    path = archive(tmp_path / "log.pt", content, arrays)
    recording = read_recording(path, kp=2.0, kd=0.0)
    assert recording.q == pytest.approx(q)
    assert recording.command == pytest.approx(q + 1)
    assert recording.torque_source == "command"
    assert recording.servo.kp == (2.0, 2.0)


class Harmful:
    def __reduce__(self):
        return print, ("executed",)


def test_code_in_an_archive_is_refused_not_executed(tmp_path, capfd):
    with zipfile.ZipFile(tmp_path / "bad.pt", "w") as file:
        file.writestr("log/data.pkl", pickle.dumps({"time": Harmful()}))
    with pytest.raises(RecordingError, match="not read for safety"):
        read_recording(tmp_path / "bad.pt")
    assert "executed" not in capfd.readouterr().out


def sage(folder, n=20):
    folder.mkdir()
    (folder / "joint_list.txt").write_text("One\nTwo\n")
    rows = [(20000.0 * k, [0.1 * k, -0.1 * k]) for k in range(n)]
    states = "\n".join(f'STATE_MOTOR,{t},"{x}","{x}","[0.5, 0.5]"' for t, x in rows)
    commands = "\n".join(f'CONTROL,{t - 1},"{[v + 1 for v in x]}"' for t, x in rows[::2])
    head = "type,timestamp,positions,velocities,torques\n"
    (folder / "state_motor.csv").write_text(head + states + "\n")
    (folder / "control.csv").write_text(f"type,timestamp,positions\n{commands}\n")
    return folder


def test_a_sage_folder_is_read_with_the_last_command_before_each_state(tmp_path):
    recording = read_recording(sage(tmp_path / "motion"), torque_source="command")
    assert recording.joint_names == ("One", "Two")
    assert recording.rate == pytest.approx(50.0)
    assert recording.q[3] == pytest.approx([0.3, -0.3])
    assert recording.command[3] == pytest.approx([1.2, 0.8])
    assert np.isnan(recording.servo.kp).all()


def test_joints_of_other_names_are_given_in_a_sheet(tmp_path):
    folder, model = sage(tmp_path / "motion"), load_robot("two-link")
    with pytest.raises(RecordingError, match="One, Two"):
        read_recording(folder, model=model)
    sheet = {"joints": {"Two": "joint_1", "One": "joint_2"}, "torque_source": "command"}
    recording = read_recording(folder, model=model, sheet=sheet, kp=(3.0, float("nan")))
    assert recording.q[3] == pytest.approx([-0.3, 0.3])
    assert recording.servo.kp[0] == 3.0


def lerobot(folder):
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    names = ["elbow.pos", "wrist.pos"]
    features = {key: {"names": names, "shape": [2]} for key in ("observation.state", "action")}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": features}))
    for episode in (1, 0):
        values = [[90.0 + k, float(episode)] for k in range(10)]
        pl.DataFrame(
            {
                "observation.state": values,
                "action": values,
                "timestamp": [k / 30 for k in range(10)],
                "frame_index": list(range(10)),
                "episode_index": [episode] * 10,
            }
        ).write_parquet(folder / "data" / "chunk-000" / f"episode_{episode:06d}.parquet")
    return folder


def test_a_lerobot_dataset_is_read_once_its_unit_is_said(tmp_path):
    folder = lerobot(tmp_path / "set")
    with pytest.raises(
        RecordingError,
        match=r"unit of elbow, which runs from 90 to 99, .* -100 to 100",
    ):
        read_recording(folder)
    recording = read_recording(folder, sheet={"units": {"position": "deg", "command": "deg"}})
    assert recording.joint_names == ("elbow", "wrist")
    assert recording.q[0, 0] == pytest.approx(np.pi / 2)
    assert recording.command[0, 0] == pytest.approx(np.pi / 2)
    assert recording.q[:, 1] == pytest.approx(np.repeat([0.0, np.pi / 180], 10))
    steps = np.diff(recording.t)
    assert steps.min() == pytest.approx(1 / 30)
    assert np.count_nonzero(steps > 1.0) == 1


def calibrated(folder, amplitude, **changes):
    """Write a dataset whose elbow swings by `amplitude`, with ranges of 60 and 120 degrees."""
    folder.mkdir()
    (folder / "meta").mkdir()
    (folder / "data").mkdir()
    names = ["elbow.pos", "wrist.pos", "gripper.pos"]
    features = {key: {"names": names, "shape": [3]} for key in ("observation.state", "action")}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    counts = {"elbow": (1000, 1000 + 4096 // 3), "wrist": (0, 4096 // 3 * 2), "gripper": (0, 1024)}
    servos = {
        name: {"id": 1, "drive_mode": 0, "homing_offset": -7, "range_min": low, "range_max": high}
        for name, (low, high) in counts.items()
    }
    servos["wrist"]["drive_mode"] = 1
    servos["elbow"].update(changes)
    (folder.parent / "my_follower.json").write_text(json.dumps(servos))
    wave = np.sin(np.linspace(0.0, 20.0, 500))
    values = np.column_stack([amplitude * wave, 50.0 * wave, 50.0 + 50.0 * wave]).tolist()
    pl.DataFrame(
        {"observation.state": values, "action": values, "frame_index": list(range(500))}
    ).write_parquet(folder / "data" / "file.parquet")
    return folder, wave


def test_a_calibration_gives_shares_of_the_range_their_angles(tmp_path):
    """As LeRobot does: norm = (counts - min) / (max - min) * 200 - 100, 4096 counts a turn."""
    folder, wave = calibrated(tmp_path / "set", 95.0)
    recording = read_recording(folder)
    elbow = (0.95 * wave) * (4096 // 3) / 2 * 2 * np.pi / 4096
    wrist = (-0.5 * wave) * (4096 // 3) * 2 * np.pi / 4096
    gripper = (0.5 + 0.5 * wave) * np.pi / 2
    assert np.allclose(recording.q, np.column_stack([elbow, wrist, gripper]), atol=1e-6)
    assert np.allclose(recording.command, recording.q)
    assert any("-100 to 100 of the range" in note for note in recording.notes)


def test_a_calibration_leaves_degrees_degrees(tmp_path):
    folder, wave = calibrated(tmp_path / "set", 130.0)
    recording = read_recording(folder)
    assert np.allclose(recording.q[:, 0], np.deg2rad(130.0 * wave), atol=1e-6)
    assert np.allclose(recording.q[:, 2], (0.5 + 0.5 * wave) * np.pi / 2, atol=1e-6)


def test_where_a_motion_fits_both_units_the_error_has_the_complete_sheet(tmp_path):
    folder, wave = calibrated(tmp_path / "set", 40.0)
    with pytest.raises(RecordingError, match="degrees and -100 to 100") as caught:
        read_recording(folder)
    lines = str(caught.value.cure).partition("[joint_units]")[2]
    sheet = tomllib.loads(f"[joint_units]{lines}")
    assert set(sheet["joint_units"]) == {"elbow", "wrist"}
    shares = read_recording(folder, sheet=sheet)
    assert np.allclose(shares.q[:, 0], 0.4 * wave * np.pi / 3, atol=1e-3)
    degrees = read_recording(folder, sheet={"units": {"position": "deg", "command": "deg"}})
    assert np.allclose(degrees.q[:, 0], np.deg2rad(40.0 * wave), atol=1e-6)
    assert np.allclose(degrees.q[:, 2], shares.q[:, 2])


def test_a_range_without_extent_is_named(tmp_path):
    folder, _ = calibrated(tmp_path / "set", 95.0, range_max=1000)
    with pytest.raises(RecordingError, match="elbow has the range 1000 to 1000"):
        read_recording(folder)


def test_two_calibrations_are_not_guessed_between(tmp_path):
    folder, _ = calibrated(tmp_path / "set", 95.0)
    text = (tmp_path / "my_follower.json").read_text()
    (tmp_path / "my_leader.json").write_text(text)
    assert read_recording(folder).n_samples == 500
    (tmp_path / "my_follower.json").rename(tmp_path / "another.json")
    with pytest.raises(RecordingError, match="several calibrations"):
        read_recording(folder)


GRIPPER = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><mass value="1"/><origin xyz="0.1 0 0"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="jaw"><inertial><mass value="0.1"/><origin xyz="0 0.01 0"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="5" velocity="5"/></joint>
<joint name="gripper" type="revolute"><parent link="upper"/><child link="jaw"/>
<axis xyz="0 0 1"/><limit lower="0" upper="1.7" effort="5" velocity="5"/></joint></robot>"""


def with_gripper(folder, third=False):
    """Write a dataset of v2 or v3 with degrees, a gripper from 0 to 100, and a velocity."""
    (folder / "meta").mkdir(parents=True)
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    names = ["elbow.pos", "gripper.pos", "elbow.vel"]
    features = {
        "observation.state": {"names": names if third else {"motors": names}, "shape": [3]},
        "action": {"names": names[:2], "shape": [2]},
    }
    version = "v3.0" if third else "v2.1"
    info = {"codebase_version": version, "fps": 30, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    rows = {
        "observation.state": [[90.0 - k, 5.0 * k, 7.0] for k in range(20)],
        "action": [[80.0 - k, 100.0 - 5.0 * k] for k in range(20)],
        "timestamp": np.arange(20, dtype="f4") / 30,
        "frame_index": list(range(20)),
        "episode_index": [0] * 20,
    }
    file = data / ("file-000.parquet" if third else "episode_000000.parquet")
    pl.DataFrame(rows).write_parquet(file)
    return folder


@pytest.mark.parametrize("third", [False, True])
def test_the_unit_of_a_gripper_is_asked_for(tmp_path, third):
    folder = with_gripper(tmp_path / "set", third)
    (tmp_path / "arm.urdf").write_text(GRIPPER)
    model, degrees = load_robot(tmp_path / "arm.urdf"), {"units": {"position": "deg"}}
    with pytest.raises(RecordingError, match="gripper, which runs from 0 to 95, is not") as caught:
        read_recording(folder, model=model, sheet=degrees)
    assert "[joint_units] gripper = { logged" in str(caught.value.cure)
    share = {"gripper": {"logged": [0, 100], "position": [-0.2, 1.8]}}
    recording = read_recording(folder, model=model, sheet={**degrees, "joint_units": share})
    rows = np.arange(20.0)
    assert recording.q[:, 0] == pytest.approx(np.radians(90.0 - rows))
    assert recording.command[:, 0] == pytest.approx(np.radians(80.0 - rows))
    assert recording.q[:, 1] == pytest.approx(-0.2 + 0.1 * rows)
    assert recording.command[:, 1] == pytest.approx(1.8 - 0.1 * rows)
    assert any("observation.state elbow.vel" in note for note in recording.notes)
    held = read_recording(folder, model=model, sheet=degrees, lock="gripper=0.3")
    assert held.q[:, 0] == pytest.approx(np.radians(90.0 - rows))
    with pytest.raises(RecordingError, match="unit of gripper"):
        read_recording(folder, model=model, sheet=degrees, lock="gripper")
    alone = read_recording(folder, model=model.locked(["gripper"]), sheet=degrees)
    assert alone.joint_names == ("elbow",)


def test_shares_of_a_range_are_converted_joint_by_joint(tmp_path):
    folder, ends = with_gripper(tmp_path / "set"), {"logged": [-100, 100], "position": [-2, 2]}
    with pytest.raises(RecordingError, match="unit of elbow, which runs from 71 to 90"):
        read_recording(folder, sheet={"joint_units": {"gripper": "deg"}})
    sheet = {"joint_units": {"gripper": "deg", "elbow": ends}}
    recording = read_recording(folder, sheet=sheet)
    assert recording.q[0] == pytest.approx([1.8, 0.0])
    assert recording.command[0] == pytest.approx([1.6, np.radians(100.0)])
    with pytest.raises(RecordingError, match="gives units of wrist"):
        read_recording(folder, sheet={"joint_units": {**sheet["joint_units"], "wrist": "deg"}})
    for bad, said in ((ends | {"logged": [1, 1]}, "no extent"), ("furlong", "is not known")):
        (tmp_path / "sheet.toml").write_text(f"[joint_units]\nelbow = {toml(bad)}\n")
        with pytest.raises(RecordingError, match=said):
            read_recording(folder, sheet=tmp_path / "sheet.toml")


def toml(value):
    if isinstance(value, str):
        return f'"{value}"'
    return "{ " + ", ".join(f"{name} = {each}" for name, each in value.items()) + " }"


def test_recordings_of_real_robots_with_commands_are_read():
    data, models = SHARED / "data", SHARED / "models"
    if not data.is_dir():
        pytest.skip("shared data are absent")
    dog = models / "go2" / "go2.xml"
    with pytest.raises(DescriptionError, match="free joint"):
        load_robot(dog)
    model, ((log,),) = read_fitted_recordings(
        load_robot(dog, fixed_base=True), (data / "go2_hung" / "traj_0.pt",)
    )
    assert (log.n_samples, model.n_joints) == (4698, 12)
    assert log.rate == pytest.approx(200.0, rel=1e-3)
    jaw = {"joint_units": {"Jaw": {"logged": [0, 1], "position": [-0.17, 1.75]}}}
    with pytest.raises(RecordingError, match="the unit of Jaw"):
        read_recording(data / "so101_sage" / "multisine")
    arm = read_recording(data / "so101_sage" / "multisine", sheet=jaw)
    assert arm.command.shape == arm.q.shape == (6000, 6)


def test_limits_of_the_goal_are_read_from_sheet_and_options(tmp_path):
    folder = sage(tmp_path / "motion")
    sheet = {"torque_source": "command", "goal_acceleration": [39.0, "none"]}
    recording = read_recording(folder, sheet=sheet)
    assert recording.servo.goal_acceleration == (39.0, np.inf)
    assert recording.servo.goal_speed == (np.inf, np.inf)
    unsaid = read_recording(folder, torque_source="command")
    assert np.isnan(unsaid.servo.goal_acceleration).all()
    options = {"goal_acceleration": parse_servo_numbers("20, auto"), "goal_speed": (3.0,)}
    given = read_recording(folder, sheet=sheet, **options)
    assert given.servo.goal_acceleration[0] == 20.0
    assert np.isnan(given.servo.goal_acceleration[1])
    assert given.servo.goal_speed == (3.0, 3.0)
    assert parse_servo_numbers("none, auto")[0] == np.inf
