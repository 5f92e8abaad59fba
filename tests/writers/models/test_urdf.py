import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest
from pinocchio_oracle import random_robot
from reload_oracle import as_if_identified, pinocchio_torques, two_armed

from asbuilt.description import JointLimits, LinkInertia, RobotModel, bundled_robot
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import InertiaError
from asbuilt.writers import write_urdf
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.urdf import format_urdf

BUNDLED = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "scara", "two-link")


def check_reloads(model: RobotModel) -> RobotModel:
    text = format_urdf(model)
    q, qd, qdd = draw_sample_states(model, 30)
    expected = inverse_dynamics(model, q, qd, qdd)
    tolerance = 1e-12 * np.abs(expected).max() + 1e-12
    found = pinocchio_torques(text.partition("?>")[2], model.joint_names, model.gravity, q, qd, qdd)
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    read = read_urdf(text).with_gravity(model.gravity)
    order = [read.joint_names.index(name) for name in model.joint_names]
    back = np.argsort(order)
    np.testing.assert_allclose(
        inverse_dynamics(read, q[:, back], qd[:, back], qdd[:, back])[:, order],
        expected,
        rtol=0,
        atol=tolerance,
    )
    assert {joint.drive.viscous for joint in read.joints} == {
        joint.drive.viscous for joint in model.joints
    }
    assert {joint.drive.coulomb for joint in read.joints} == {
        joint.drive.coulomb for joint in model.joints
    }
    return read


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_robots(name: str) -> None:
    model = as_if_identified(bundled_robot(name), 3)
    read = check_reloads(model)
    assert read.joint_names == model.joint_names
    assert read.link_names == model.link_names
    assert {frame.name for frame in model.frames} <= {frame.name for frame in read.frames}


@pytest.mark.parametrize("seed", range(4))
def test_random_trees_under_tilted_gravity(seed: int) -> None:
    check_reloads(random_robot(np.random.default_rng(seed), 7))


def test_two_arms() -> None:
    check_reloads(as_if_identified(two_armed(), 4))


def test_descriptions_of_strangers_written_afresh(shared: Path) -> None:
    model = read_urdf(shared / "models" / "lbrstack_med7.urdf")
    read = check_reloads(model)
    for joint, there in zip(model.joints, read.joints, strict=True):
        np.testing.assert_allclose(there.before, joint.before, atol=1e-15)
        np.testing.assert_allclose(there.after, joint.after, atol=1e-15)
        assert there.limits == joint.limits


def test_hostile_names_and_notes_stay_text(example: Any) -> None:
    model = as_if_identified(example.model, 1)
    model = replace(model, notes=("a -- b --> <link name='x'/>---", "c ---> d -----> -"))
    text = format_urdf(model)
    assert fromstring(text).get("name") == model.name
    read = check_reloads(model)
    assert read.joint_names == model.joint_names
    assert "armature" in text
    assert "URDF has no place for gravity" in text


def test_unknown_limits_are_written_as_large_ones() -> None:
    model = bundled_robot("scara")
    model = model.with_limits([JointLimits()] * model.n_joints)
    read = read_urdf(format_urdf(model))
    assert [joint.kind for joint in read.joints] == [
        "continuous",
        "continuous",
        "prismatic",
        "continuous",
    ]
    assert read.joints[2].limits.upper == 1e9


def test_impossible_models_are_refused() -> None:
    model = bundled_robot("two-link")
    impossible = LinkInertia.from_com(1.0, np.zeros(3), np.diag([0.1, 0.1, 0.3]))
    with pytest.raises(InertiaError, match="link 2: Ixx"):
        format_urdf(
            replace(model, links=(model.links[0], replace(model.links[1], inertia=impossible)))
        )


def test_written_file_says_what_it_leaves_out(tmp_path: Path) -> None:
    model = as_if_identified(bundled_robot("two-link"), 1)
    path, notes = write_urdf(tmp_path / "robot.urdf", model)
    assert path.read_text(encoding="utf-8") == format_urdf(model)
    assert len(notes) == 2
    assert re.search(r"<!-- armature 0\.\d+, offset -?\d", path.read_text(encoding="utf-8"))
