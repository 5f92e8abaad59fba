"""Conversion of descriptions: torques of the file read back are those of the robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot, load_robot, robot_names
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import DescriptionError, InertiaError, UsageError
from asbuilt.writers import Conversion, convert_robot

SHARED = Path(__file__).parents[3] / ".." / "shared" / "models"
FILES = (
    "iiwa14.urdf", "kuka_lwr4.urdf", "lbrstack_iiwa7.urdf", "lbrstack_med7.urdf", "ur10.urdf",
    "ur10e.urdf", "xarm7.urdf", "airbot/airbot_play.urdf", "airbot/airbot_play_gripper.urdf",
    "so101/so101_new_calib.urdf", "staubli_tx40.toml", "rokae_xmate.toml",
)  # fmt: skip
KINDS = ("toml", "urdf", "xml")


def test_bundled_robots_keep_their_torques(tmp_path: Path) -> None:
    for name in robot_names():
        for kind in KINDS:
            if name == "puma-560" and kind != "toml":
                with pytest.raises(InertiaError, match="mass is 0"):
                    convert_robot(name, tmp_path / f"{name}.{kind}")
            elif name.startswith("dvrk") and kind == "urdf":
                with pytest.raises(DescriptionError, match="<mimic> follows one joint"):
                    convert_robot(name, tmp_path / f"{name}.{kind}")
            elif name == "four-bar":
                _refused_or_read(name, tmp_path / f"{name}.{kind}")
            else:
                _same(convert_robot(name, tmp_path / f"{name}.{kind}"))


@pytest.mark.parametrize("file", FILES)
def test_shared_descriptions_keep_their_torques(file: str, tmp_path: Path) -> None:
    if not (SHARED / file).is_file():
        pytest.skip("the shared descriptions are absent")
    for kind in KINDS:
        _same(convert_robot(SHARED / file, tmp_path / f"robot.{kind}"))


def _refused_or_read(name: str, path: Path) -> None:
    """Convert a robot with a loop, which a URDF has not; its torques are on postures that close."""
    if path.suffix == ".urdf":
        with pytest.raises(DescriptionError, match="URDF has no loops"):
            convert_robot(name, path)
        return
    converted = convert_robot(name, path)
    assert len(load_robot(path).loops) == len(converted.robot.loops) == 1
    assert np.nanmax(converted.torque_difference) < 1e-9


def _same(converted: Conversion) -> None:
    """Compare torques at states of this test's own, joints by name."""
    if converted.path.suffix == ".xml":
        pytest.importorskip("mujoco")
    model, again = converted.robot, load_robot(converted.path)
    assert sorted(again.joint_names) == sorted(model.joint_names)
    q, qd, qdd = np.random.default_rng(8).uniform(-2.0, 2.0, (3, 30, model.n_joints))
    order = [model.joint_names.index(name) for name in again.joint_names]
    expected = inverse_dynamics(model, q, qd, qdd)[:, order]
    torque = inverse_dynamics(
        again.with_gravity(model.gravity), q[:, order], qd[:, order], qdd[:, order]
    )
    assert np.abs(torque - expected).max() <= 1e-12 * max(1.0, np.abs(expected).max())
    assert np.nanmax(converted.torque_difference) < 1e-9


def test_locks_and_gravity_are_written(tmp_path: Path) -> None:
    model = bundled_robot("ur10e")
    robot = model.locked({model.joint_names[5]: 0.3}).with_gravity((9.81, 0.0, 0.0))
    converted = convert_robot(robot, tmp_path / "robot.toml")
    again = load_robot(converted.path)
    assert again.joint_names == model.joint_names[:5]
    assert again.gravity.tolist() == [9.81, 0.0, 0.0]
    assert any("locked when converted" in note for note in again.notes)
    assert any("gravity" in note for note in convert_robot(robot, tmp_path / "robot.urdf").notes)


def test_the_coupling_that_is_lost_is_named(tmp_path: Path) -> None:
    file = SHARED / "staubli_tx40.toml"
    if not file.is_file():
        pytest.skip("the shared descriptions are absent")
    notes = convert_robot(file, tmp_path / "robot.urdf").notes
    assert any("coupling of the motors" in note for note in notes)
    toml = load_robot(convert_robot(file, tmp_path / "robot.toml").path)
    np.testing.assert_array_equal(toml.motor_coupling, load_robot(file).motor_coupling)


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="names no format to write"):
        convert_robot("two-link", tmp_path / "robot.sdf")
