"""What stands for drive terms that URDF and MJCF lack, and what has them in MuJoCo."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from reload_oracle import as_if_identified, mujoco_torques, pinocchio_torques
from test_export import result_of
from test_rich_drives import RICH, rich_result, torques_of

import asbuilt
from asbuilt import StudyOptions, VirtualRobot
from asbuilt.description import DriveValues, bundled_robot
from asbuilt.identification import IdentificationResult
from asbuilt.writers import export_result
from asbuilt.writers.models.as_built import draw_sample_states

LOADED = "armature,viscous,coulomb,offset,load_friction"


def attach(path: Path, model: mujoco.MjModel) -> None:
    """Import a written callback and attach it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.attach(model)


def torques_with_callback(
    model: mujoco.MjModel, names: tuple[str, ...], states: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Return the torques of drives by MuJoCo, whose friction loss is that of the call before."""
    data = mujoco.MjData(model)
    at = [model.joint(name).id for name in names]
    found = []
    for q, qd, qdd in zip(*states, strict=True):
        for _ in range(2):
            data.qpos[at], data.qvel[at], data.qacc[at] = q, qd, qdd
            mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse[at] - model.actuator_biasprm[:, 0])
    return np.array(found)


@pytest.fixture(autouse=True)
def without_callback() -> Any:
    yield
    mujoco.set_mjcb_passive(None)


@pytest.fixture(scope="module")
def loaded() -> tuple[IdentificationResult, asbuilt.Recording]:
    """A two-link arm whose gears have friction by their load, and its recording."""
    robot = bundled_robot("two-link")
    drive = DriveValues(
        armature=0.1, viscous=0.2, coulomb=0.3, terms={"load_friction": {"Fl": 0.15}}
    )
    truth = replace(robot, joints=tuple(replace(joint, drive=drive) for joint in robot.joints))
    motion = asbuilt.random_fourier(robot, 3, duration=20.0, n_harmonics=10)
    recording = VirtualRobot.ideal(truth).record(motion, 0).recording
    study = asbuilt.identify(robot, [recording], options=StudyOptions(drive=LOADED))
    return study.result, recording


@pytest.mark.parametrize("name", [*RICH])
def test_the_callback_gives_the_torques_of_the_result(name: str, tmp_path: Path) -> None:
    result = rich_result(name)
    files = export_result(result, mjcf=tmp_path / "my robot.xml").files
    assert files["mjcf_passive"].name == "my_robot_passive.py"
    q, qd, qdd = draw_sample_states(result.model, 20)
    # Friction loss is a constraint, which is complete beyond `|qdd|` times a millisecond.
    qd = np.where(np.abs(qd) < 0.3, 0.3 * np.sign(qd) + 0.1, qd)
    model = mujoco.MjModel.from_xml_path(str(files["mjcf"]))
    attach(files["mjcf_passive"], model)
    found = torques_with_callback(model, result.model.joint_names, (q, qd, qdd))
    np.testing.assert_allclose(found, torques_of(result, q, qd, qdd), rtol=0, atol=1e-9)


def test_what_is_lost_is_what_mujoco_lacks_on_the_recording(
    loaded: tuple[IdentificationResult, asbuilt.Recording], tmp_path: Path
) -> None:
    """The share is that of MuJoCo's torque, and other friction and bias lose hardly less.

    Only about: the fit saw torques below 7 Hz, where friction turns less sharply.
    """
    result, _ = loaded
    exported = export_result(result, mjcf=tmp_path / "arm.xml")
    motion = asbuilt.random_fourier(result.model, 3, duration=20.0, n_harmonics=10)
    t = np.linspace(0.5, 19.5, 1000)
    q, qd, qdd = motion.at(t)
    wanted = result.torque(q, qd, qdd)
    model = mujoco.MjModel.from_xml_path(str(exported.files["mjcf"]))
    written = mujoco_torques(exported.files["mjcf"].read_text(), ("joint_1", "joint_2"), q, qd, qdd)
    apart = wanted - (written - model.actuator_biasprm[:, 0])
    share = np.linalg.norm(apart, axis=0) / np.linalg.norm(wanted, axis=0)
    lost = [each["lost"] for each in exported.as_document()["lost"]["mjcf"]]
    np.testing.assert_allclose(lost, share, rtol=0.25)
    for k in range(2):
        columns = np.stack([qd[:, k], np.sign(qd[:, k]), np.ones(len(t))], axis=1)
        rest = apart[:, k] - columns @ np.linalg.lstsq(columns, apart[:, k], rcond=None)[0]
        assert np.linalg.norm(rest) > 0.8 * np.linalg.norm(apart[:, k])
    said = exported.notes["mjcf"][0]
    assert "load_friction" in said
    assert "arm_passive.attach(model)" in said
    assert said in exported.files["mjcf"].read_text()
    assert "load_friction" not in "".join(exported.notes["mjcf"][1:])


def test_a_robot_with_friction_by_load_rests_in_mujoco(
    loaded: tuple[IdentificationResult, asbuilt.Recording], tmp_path: Path
) -> None:
    """Friction by load holds the share Fl of a weight, and more friction than that any weight."""
    result, _ = loaded
    files = export_result(result, mjcf=tmp_path / "arm.xml").files
    model = mujoco.MjModel.from_xml_path(str(files["mjcf"]))
    attach(files["mjcf_passive"], model)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.4, -0.8
    weight = result.gravity(data.qpos.copy())
    held = weight + model.actuator_biasprm[:, 0] * -1.0
    # Less than the weight by what friction by load carries.
    data.ctrl[:] = held - 0.1 * weight
    for _ in range(500):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, (0.4, -0.8), atol=2e-3)


def test_a_balancer_is_a_spring_without_free_length(tmp_path: Path) -> None:
    model = bundled_robot("ur10e")
    bodies = as_if_identified(model, 2, drives=False)
    result = result_of(model, bodies, drive="viscous,balancer:joints=2/3", variance=1e-20)
    values = [
        replace(each, estimate=300.0 * (number % 3 - 1.2))
        if each.name[:2] in ("Bs", "Bc")
        else each
        for number, each in enumerate(result.parameters)
    ]
    result = replace(result, parameters=tuple(values))
    exported = export_result(result, mjcf=tmp_path / "robot.xml")
    assert "balancer" not in " ".join(exported.notes.get("mjcf", ()))
    states = draw_sample_states(model, 20)
    text = exported.files["mjcf"].read_text()
    assert "balancer at elbow_joint" in text
    found = mujoco_torques(text, model.joint_names, *states)
    np.testing.assert_allclose(found, torques_of(result, *states), rtol=0, atol=1e-9)


def test_urdf_says_what_its_gravity_and_missing_terms_lose(tmp_path: Path) -> None:
    """A tilted arm with armature, offset and spring, by the torque that Pinocchio finds."""
    upright = bundled_robot("kuka-iiwa7-r800")
    model = upright.with_gravity([0.6, 0.0, -9.79])
    drive = "armature,viscous,coulomb,offset,spring:joints=2"
    result = result_of(model, as_if_identified(model, 2), drive=drive, variance=1e-20)
    exported = export_result(result, urdf=tmp_path / "robot.urdf")
    q, qd, qdd = draw_sample_states(model, 1000)
    usual = np.array([0.0, 0.0, -9.80665])
    text = exported.files["urdf"].read_text()
    rigid = pinocchio_torques(text, model.joint_names, usual, q, qd, qdd)
    joints = asbuilt.load_robot(exported.files["urdf"]).joints
    friction = np.array([[joint.drive.viscous, joint.drive.coulomb] for joint in joints])
    written = rigid + friction[:, 0] * qd + friction[:, 1] * np.sign(qd)
    wanted = torques_of(result, q, qd, qdd)
    share = np.linalg.norm(wanted - written, axis=0) / np.linalg.norm(wanted, axis=0)
    lost = [each["lost"] for each in exported.as_document()["lost"]["urdf"]]
    # Tilt and drives are added as squares, as if they were independent.
    np.testing.assert_allclose(lost, share, rtol=0.05)
    assert "on random motion" in exported.notes["urdf"][0]


def test_a_complete_file_loses_nothing_and_has_no_callback(tmp_path: Path) -> None:
    model = bundled_robot("scara")
    result = result_of(model, as_if_identified(model, 2), variance=1e-20)
    exported = export_result(result, mjcf=tmp_path / "robot.xml")
    assert [*exported.files] == ["mjcf"]
    assert all(each["lost"] == 0.0 for each in exported.as_document()["lost"]["mjcf"])
    assert not any("nearest" in note for note in exported.notes["mjcf"])


def test_a_joint_without_torque_in_the_recordings_has_no_share(
    loaded: tuple[IdentificationResult, asbuilt.Recording], tmp_path: Path
) -> None:
    result, _ = loaded
    data = result.cause_data
    assert data is not None
    fitted, judged = data.fitted, data.judged
    dead = replace(data, fitted=(fitted[0], 0 * fitted[1]), judged=(judged[0], 0 * judged[1]))
    silent = replace(result, cause_data=dead)
    exported = export_result(silent, mjcf=tmp_path / "arm.xml")
    first, second = exported.as_document()["lost"]["mjcf"]
    assert first["lost"] > 0.0
    assert second["lost"] is None
    assert "joint_2" not in exported.notes["mjcf"][0].partition("lacks")[2]
