"""Locked joints: torques of the robot left over are those of the whole at rest there."""

from __future__ import annotations

import json

import numpy as np
import pytest

from asbuilt.description import (
    RobotModel,
    bundled_robot,
    model_document,
    model_from_document,
    robot_names,
)
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.structure.locking import locks_from_text, report_locks
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.writers.models.robot_toml import format_robot_toml

GRIPPER = """<robot name="hand">
<link name="base"/>
<link name="arm"><inertial><origin xyz="0.1 0 0.2"/><mass value="3"/>
<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
<link name="left"><inertial><origin xyz="0 0.02 0"/><mass value="0.2"/>
<inertia ixx="0.0002" iyy="0.0003" izz="0.0004" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="right"><inertial><origin xyz="0 -0.02 0"/><mass value="0.3"/>
<inertia ixx="0.0002" iyy="0.0003" izz="0.0004" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/>
<origin xyz="0 0 0.3" rpy="0.3 0.2 0.1"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="9" velocity="2"/></joint>
<joint name="finger" type="prismatic"><parent link="arm"/><child link="left"/>
<origin xyz="0.3 0 0" rpy="0 0.4 0"/><axis xyz="0 1 0"/>
<limit lower="0.01" upper="0.03" effort="9" velocity="2"/></joint>
<joint name="thumb" type="revolute"><parent link="arm"/><child link="right"/>
<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="9" velocity="2"/>
<mimic joint="finger" multiplier="-2" offset="0.5"/></joint>
</robot>"""


def states(n: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(4)
    q, qd, qdd = rng.uniform(-1.5, 1.5, (3, 20, n))
    return q, qd, qdd


def held(model: RobotModel, values: dict[str, float], part: np.ndarray, fill: bool) -> np.ndarray:
    """Return states of the whole robot whose locked joints rest at their values."""
    whole = np.zeros((len(part), model.n_joints))
    free = [k for k, name in enumerate(model.joint_names) if name not in values]
    whole[:, free] = part
    if fill:
        for name, value in values.items():
            whole[:, model.joint_names.index(name)] = value
    return whole


@pytest.mark.parametrize("name", sorted({*robot_names()} - {"four-bar"}))  # it has one motor
@pytest.mark.parametrize("where", [0, -1])
def test_torques_are_those_of_the_robot_at_rest_there(name: str, where: int) -> None:
    model = bundled_robot(name)
    values = {model.joint_names[where]: 0.7}
    locked = model.locked(values)
    q, qd, qdd = states(locked.n_joints)
    whole = inverse_dynamics(
        model, held(model, values, q, True), held(model, values, qd, False),
        held(model, values, qdd, False),
    )  # fmt: skip
    free = [k for k, joint in enumerate(model.joint_names) if joint not in values]
    np.testing.assert_allclose(
        inverse_dynamics(locked, q, qd, qdd), whole[:, free], rtol=1e-12, atol=1e-11
    )


def test_names_are_kept_and_joints_in_the_middle_can_be_locked() -> None:
    model = bundled_robot("ur10e")
    values = {model.joint_names[2]: -0.4, model.joint_names[4]: 0.2}
    locked = model.locked(values)
    assert locked.locked_joints == values
    assert {model.link_names[2], model.link_names[4]} <= {frame.name for frame in locked.frames}
    assert model.link_names[2] in [name for name, _ in locked.links[1].parts]
    assert model.locked(values).locked({}) is not model
    assert sum(link.inertia.mass for link in locked.links) == pytest.approx(
        sum(link.inertia.mass for link in model.links)
    )
    twice = model.locked([model.joint_names[2]]).locked([model.joint_names[4]])
    assert list(twice.locked_joints) == list(values)


def test_mimic_joints_follow_the_joint_that_is_locked() -> None:
    model = read_urdf(GRIPPER)
    assert [joint.name for joint in model.followers] == ["thumb"]
    assert model.locked(["finger"]).locked_joints == pytest.approx({"finger": 0.02, "thumb": 0.46})
    locked = model.locked({"finger": 0.03})
    assert locked.locked_joints == pytest.approx({"finger": 0.03, "thumb": 0.44})
    assert locked.joint_names == ("shoulder",)
    alone = model.locked(["thumb"])
    assert alone.joint_names == ("shoulder", "finger")
    assert alone.locked_joints == pytest.approx({"thumb": 0.46})


def test_mimics_and_locks_are_stored() -> None:
    model = read_urdf(GRIPPER)
    again = model_from_document(json.loads(json.dumps(model_document(model))))
    assert again.followers[0].mimic == model.followers[0].mimic
    locked = model.locked(["finger"])
    again = model_from_document(json.loads(json.dumps(model_document(locked))))
    assert again.locked_joints == locked.locked_joints
    assert robot_from_toml(format_robot_toml(model)).followers[0].mimic == model.followers[0].mimic
    assert not robot_from_toml(format_robot_toml(model)).drives_by_design


def test_coupled_motors_are_left_over_or_refused() -> None:
    model = bundled_robot("two-link")
    crossed = RobotModel(
        model.name, model.joints, model.links, motor_coupling=np.array([[0.0, 1.0], [1.0, 0.0]])
    )
    with pytest.raises(DescriptionError, match="coupled"):
        crossed.locked(["joint_2"])
    skewed = RobotModel(
        model.name, model.joints, model.links, motor_coupling=np.array([[1.0, 0.0], [1.0, 1.0]])
    )
    assert skewed.locked(["joint_2"]).motor_coupling is None


def test_what_cannot_be_locked_is_refused() -> None:
    model = bundled_robot("two-link")
    with pytest.raises(DescriptionError, match=r"no joint 'wrist' to lock; its joints are joint_1"):
        model.locked(["wrist"])
    with pytest.raises(DescriptionError, match="all joints are locked"):
        model.locked(["joint_1", "joint_2"])
    with pytest.raises(DescriptionError, match=r"locked at 0.5 already"):
        model.locked({"joint_1": 0.5}).locked({"joint_1": 0.6})
    for text in ("a=", "=1", "a=x", "a=nan", "", "a=1e308", "a=0,a=1"):
        with pytest.raises(UsageError, match="JOINT=VALUE"):
            locks_from_text(text)


def test_a_finding_names_the_locked_joints() -> None:
    model = bundled_robot("two-link")
    assert not [*report_locks(model)]
    (finding,) = report_locks(model.locked({"joint_2": 0.5}))
    assert finding.code == "joints_locked"
    assert "joint_2 at 0.5" in finding.message
    assert finding.cure is not None
    assert finding.cure.settings == {"lock": "joint_2=VALUE"}


def test_a_tilt_that_was_found_is_kept() -> None:
    model = bundled_robot("ur10e")
    tilted = model.tilted(np.array([0.1, 0.0, -9.8]))
    again = model_from_document(json.loads(json.dumps(model_document(tilted))))
    np.testing.assert_array_equal(again.gravity, [0.1, 0.0, -9.8])
    np.testing.assert_array_equal(again.as_described.gravity, model.gravity)
    assert "described_gravity" not in model_document(again.as_described)
