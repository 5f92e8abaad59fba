"""Recordings that lack joints of the robot, and joints that are not to be identified."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import (
    Joint,
    JointLimits,
    Link,
    LinkInertia,
    Mimic,
    RobotModel,
    bundled_robot,
    model_document,
    model_from_document,
)
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.joint_matching import find_unlabelled_joints
from asbuilt.description.structure.locking import report_locks
from asbuilt.errors import RecordingError, UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    ReadingOptions,
    check_recording,
    read_fitted_recordings,
    simulate_recording,
)
from asbuilt.workflow import StudyOptions, identify
from asbuilt.writers import write_recording

SHARED = Path(__file__).parents[3] / ".." / "shared"


def with_fingers(model: RobotModel) -> RobotModel:
    """Return a robot with two prismatic fingers on its last link."""
    last = model.n_joints - 1
    place = np.eye(4)
    place[2, 3] = 0.1
    body = LinkInertia.from_com(0.2, (0.0, 0.01, 0.02), 1e-4 * np.eye(3))
    fingers = tuple(
        Joint(name, "prismatic", last, place, np.eye(4), JointLimits(0.01, 0.05))
        for name in ("finger_left", "finger_right")
    )
    links = tuple(Link(name, body) for name in ("left", "right"))
    return replace(model, joints=(*model.joints, *fingers), links=(*model.links, *links))


@pytest.fixture(scope="module")
def hand() -> RobotModel:
    return with_fingers(bundled_robot("ur10e"))


@pytest.fixture(scope="module")
def log(hand: RobotModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of the arm while both fingers stand at 0.03 m."""
    arm = hand.locked(["finger_left", "finger_right"])
    motion = random_fourier(arm, rng=2, duration=8.0)
    recording = simulate_recording(arm, motion, rate=100.0, rng=3)
    return write_recording(tmp_path_factory.mktemp("log") / "log.csv", recording)


def test_a_log_without_fingers_locks_them(hand: RobotModel, log: Path) -> None:
    model, ((recording,),) = read_fitted_recordings(hand, [[log]])
    assert model.locked_joints == pytest.approx({"finger_left": 0.03, "finger_right": 0.03})
    assert recording.joint_names == model.joint_names == bundled_robot("ur10e").joint_names
    check = check_recording(model, recording)
    assert check.ok
    assert "joints_locked" in check.codes
    other, _ = read_fitted_recordings(hand, [[log]], ReadingOptions(lock="finger_left=0.02"))
    assert other.locked_joints == pytest.approx({"finger_left": 0.02, "finger_right": 0.03})


def test_a_finger_that_follows_one_which_moves_is_named(hand: RobotModel, log: Path) -> None:
    """Held still, it is missing from the torque of the other; locked together, nothing is."""
    left, right = hand.joints[-2:]
    coupled = replace(
        hand, joints=(*hand.joints[:-1], replace(right, mimic=Mimic({"finger_left": -1.0}, 0.06)))
    )
    arm = coupled.locked(["finger_right"])
    assert arm.held_followers == {"finger_right": "finger_left"}
    assert model_from_document(model_document(arm)).held_followers == arm.held_followers
    said = {each.code: each for each in report_locks(arm)}
    assert said["follower_held"].severity == "warning"
    assert "finger_right follows finger_left" in said["follower_held"].message
    assert arm.locked([left.name]).held_followers == {}
    both, ((recording,),) = read_fitted_recordings(coupled, [[log]])
    assert both.held_followers == {}
    assert "follower_held" not in check_recording(both, recording).codes


def test_identification_locks_them_too(hand: RobotModel, log: Path) -> None:
    study = identify(hand, log, options=StudyOptions(method="wls"))
    arm = hand.locked(["finger_left", "finger_right"])
    assert study.result.model.joint_names == arm.joint_names
    assert "joints_locked" in [finding.code for finding in study.findings]
    assert study.result.train.relative_error < 0.02
    stored = type(study).from_json(study.to_json())
    assert stored.result.model.locked_joints == arm.locked_joints


def test_a_sheet_locks_joints(hand: RobotModel, log: Path, tmp_path: Path) -> None:
    copy = tmp_path / "log.csv"
    copy.write_bytes(log.read_bytes())
    (tmp_path / "log.csv.toml").write_text("[lock]\nfinger_left = 0.015\n")
    model, _ = read_fitted_recordings(hand, [[copy]])
    assert model.locked_joints == pytest.approx({"finger_left": 0.015, "finger_right": 0.03})
    (tmp_path / "log.csv.toml").write_text('lock = ["finger_left"]\n')
    assert read_fitted_recordings(hand, [[copy]])[0].locked_joints["finger_left"] == pytest.approx(
        0.03
    )


def test_a_joint_that_is_logged_is_locked_where_it_stands() -> None:
    model = bundled_robot("two-link")
    t = np.arange(0.0, 2.0, 0.01)
    q = np.column_stack([np.sin(t), np.full_like(t, 0.4)])
    columns = {"t": t, "q": q, "tau": np.ones_like(q)}
    locked, ((recording,),) = read_fitted_recordings(
        model, [[columns]], ReadingOptions(lock="joint_2")
    )
    assert locked.locked_joints == {"joint_2": 0.4}
    np.testing.assert_array_equal(recording.q, q[:, :1])


def test_unnamed_columns_leave_out_a_gripper_and_nothing_else(hand: RobotModel) -> None:
    t = np.arange(0.0, 2.0, 0.01)
    six = {"t": t, "q": np.ones((t.size, 6)), "tau": np.ones((t.size, 6))}
    assert read_fitted_recordings(hand, [[six]])[0].n_joints == 6
    with pytest.raises(RecordingError, match=r"6 position columns.*kuka-iiwa7-r800 has 7 joints"):
        read_fitted_recordings(bundled_robot("kuka-iiwa7-r800"), [[six]])


def test_labels_name_some_of_the_joints() -> None:
    joints = ["left_joint1", "left_joint2", "right_joint1", "right_joint2"]
    assert find_unlabelled_joints(["left_joint1", "left_joint2"], joints) == tuple(joints[2:])
    assert find_unlabelled_joints(["q1", "q2"], joints) is None
    assert find_unlabelled_joints(["a", "b", "c", "left_joint1"], joints) is None


def test_gravity_of_the_options_replaces_that_of_the_robot(hand: RobotModel, log: Path) -> None:
    model, _ = read_fitted_recordings(hand, [[log]], ReadingOptions(gravity="-y"))
    assert model.gravity.tolist() == [0.0, -9.81, 0.0]
    assert ReadingOptions(gravity="1, 2,-3").gravity == (1.0, 2.0, -3.0)
    for wrong in ("w", "1,2", "+xy", "nan,0,0"):
        with pytest.raises(UsageError, match="three numbers"):
            ReadingOptions(gravity=wrong)


def test_the_airbot_with_its_gripper_is_the_airbot_without() -> None:
    data = SHARED / "data" / "airbot"
    if not data.is_dir():
        pytest.skip("the shared recordings are absent")
    robot = read_urdf(SHARED / "models" / "airbot" / "airbot_play_gripper.urdf")
    options = ReadingOptions(sheet=data / "sheet.toml")
    model, ((recording,),) = read_fitted_recordings(robot, [[data / "vali_opt.csv"]], options)
    assert model.locked_joints == {"endleft": 0.0, "endright": 0.0}
    assert check_recording(model, recording).ok


def test_an_arm_with_one_more_joint_is_identified_without_it(tmp_path: Path) -> None:
    file = SHARED / "models" / "xarm7.urdf"
    if not file.is_file():
        pytest.skip("the shared descriptions are absent")
    text = file.read_text()
    last = read_urdf(text).link_names[-1]
    more = (
        '<link name="jaw"><inertial><mass value="0.3"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"'
        ' ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="drive_joint" type="revolute">'
        f'<parent link="{last}"/><child link="jaw"/><origin xyz="0 0.03 0.06"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="0.85" effort="50" velocity="2"/></joint>'
    )
    robot = read_urdf(text.replace("</robot>", f"{more}</robot>"))
    arm = robot.locked(["drive_joint"])
    recording = simulate_recording(arm, random_fourier(arm, rng=1, duration=4.0), rate=100.0)
    path = write_recording(tmp_path / "log.csv", recording)
    model, ((read,),) = read_fitted_recordings(robot, [[path]])
    assert model.locked_joints == {"drive_joint": 0.0}
    assert read.joint_names == arm.joint_names


def test_joints_that_are_named_leave_those_that_a_log_counts(hand: RobotModel) -> None:
    t, arm = np.arange(300) / 100.0, bundled_robot("ur10e")
    columns = {"t": t} | {f"q_{k}": np.sin(k * t) for k in range(1, 6)}
    columns |= {f"tau_{k}": np.cos(k * t) for k in range(1, 6)}
    with pytest.raises(RecordingError, match="can be locked: wrist_3_joint"):
        read_fitted_recordings(arm, [[columns]])
    named = ReadingOptions(lock="shoulder_pan_joint")
    model, ((recording,),) = read_fitted_recordings(arm, [[columns]], named)
    assert model.joint_names == arm.joint_names[1:]
    assert recording.q[:, -1] == pytest.approx(np.sin(5 * t))
    fingers = ReadingOptions(lock="shoulder_pan_joint,finger_left,finger_right")
    model, _ = read_fitted_recordings(hand, [[columns]], fingers)
    assert model.joint_names == arm.joint_names[1:]


def test_a_missing_joint_that_carries_others_is_a_warning() -> None:
    """The weight behind it turns with a position that nobody knows; an arm's last joint is none."""
    arm = bundled_robot("ur10e")
    motion = random_fourier(arm, rng=2, duration=4.0)
    whole = simulate_recording(arm, motion, rate=100.0, rng=3)
    for missing, severity in (("elbow_joint", "warning"), ("wrist_3_joint", "info")):
        kept = [name for name in arm.joint_names if name != missing]
        columns = {"t": whole.t}
        for name in kept:
            k = arm.joint_names.index(name)
            columns |= {f"q_{name}": whole.q[:, k], f"tau_{name}": whole.tau[:, k]}
        model, _ = read_fitted_recordings(arm, [[columns]])
        (finding,) = report_locks(model)
        assert finding.severity == severity
        assert missing in finding.message
        stored = model_from_document(model_document(model))
        assert stored.assumed_carriers == model.assumed_carriers
        known, _ = read_fitted_recordings(arm, [[columns]], ReadingOptions(lock=f"{missing}=0.4"))
        assert known.assumed_carriers == ()
