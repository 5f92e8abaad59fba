"""SDF against URDF: the same robots with poses in the model's frame have the same dynamics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.formats.sdf import read_sdf
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import rotation_from_rpy, rpy_from_rotation
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import DescriptionError


def spaced(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def pose(T: np.ndarray) -> str:
    return f"<pose>{spaced([*T[:3, 3], *rpy_from_rotation(T[:3, :3])])}</pose>"


def sdf_of(model: RobotModel, rng: np.random.Generator, joint_axis: str, gravity: str = "") -> str:
    """The robot with absolute poses of links, turned and shifted at random from the joints."""
    poses = link_poses(model, np.zeros((1, model.n_joints)))[0]
    lines = [f'<sdf version="1.9">{gravity}<model name="{model.name}"><link name="floor"/>']
    for k, (link, joint) in enumerate(zip(model.links, model.joints, strict=True)):
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = rotation_from_rpy(rng.normal(size=3)), rng.normal(size=3)
        back, centre = np.linalg.inv(own), np.eye(4)
        centre[:3, 3] = link.inertia.com
        to_joint = np.linalg.inv(joint.after)
        moments = link.inertia.inertia_about_com
        inertia = "".join(
            f"<i{a}{b}>{float(moments[i, j])!r}</i{a}{b}>"
            for i, a in enumerate("xyz")
            for j, b in enumerate("xyz")
            if i <= j
        )
        xyz = "<xyz>0 0 1</xyz>"
        if joint_axis == "model":
            direction = (poses[k] @ to_joint)[:3, 2]
            xyz = f'<xyz expressed_in="__model__">{spaced(direction)}</xyz>'
        parent = "world" if joint.parent < 0 else f"body_{joint.parent}"
        lines.append(
            f'<link name="body_{k}">{pose(poses[k] @ own)}<inertial>{pose(back @ centre)}'
            f"<mass>{float(link.inertia.mass)!r}</mass><inertia>{inertia}</inertia></inertial></link>"
            f'<joint name="{joint.name}" type="revolute"><parent>{parent}</parent>'
            f"<child>body_{k}</child>{pose(back @ to_joint)}<axis>{xyz}<limit><lower>-2</lower>"
            "<upper>2</upper><effort>50</effort></limit><dynamics><damping>0.5</damping>"
            "</dynamics></axis></joint>"
        )
    return "".join([*lines, "</model></sdf>"])


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "puma-560"])
@pytest.mark.parametrize("joint_axis", ["own", "model"])
def test_absolute_poses_give_the_dynamics_of_the_robot(name: str, joint_axis: str) -> None:
    model, rng = bundled_robot(name), np.random.default_rng(5)
    read = read_sdf(sdf_of(model, rng, joint_axis))
    q, qd, qdd = rng.normal(size=(3, 20, model.n_joints))
    expected = inverse_dynamics(model, q, qd, qdd)
    np.testing.assert_allclose(inverse_dynamics(read, q, qd, qdd), expected, atol=1e-9)
    assert read.joint_names == model.joint_names
    assert read.joints[0].limits.torque == 50.0
    assert read.joints[0].drive.viscous == 0.5


def test_file_is_recognised_and_its_world_sets_gravity(tmp_path: Path) -> None:
    text = sdf_of(bundled_robot("ur10e"), np.random.default_rng(1), "own")
    world = text.replace("<model ", "<world name='w'><gravity>0 0 -1.62</gravity><model ")
    (tmp_path / "arm.sdf").write_text(world.replace("</sdf>", "</world></sdf>"))
    np.testing.assert_allclose(load_robot(tmp_path / "arm.sdf").gravity, [0, 0, -1.62])


def test_pose_of_the_model_turns_gravity() -> None:
    text = sdf_of(bundled_robot("ur10e"), np.random.default_rng(1), "own")
    turned = text.replace('<link name="floor"/>', "<pose>0 0 2 1.5707963267948966 0 0</pose>")
    np.testing.assert_allclose(read_sdf(turned).gravity, [0, -9.81, 0], atol=1e-12)


WRONG = {
    "no model": ("<sdf/>", "has 0 models"),
    "two models": ("<sdf><model name='a'/><model name='b'/></sdf>", "2 models \\(a, b\\)"),
    "included": ("<sdf><model name='a'><include/></model></sdf>", "<include>"),
    "circle": (
        "<sdf><model name='a'><link name='l'><pose relative_to='f'/></link>"
        "<frame name='f' attached_to='l'/></model></sdf>",
        "in a circle",
    ),
    "unknown frame": (
        "<sdf><model name='a'><link name='l'><pose relative_to='k'>0 0 0 0 0 0</pose></link>"
        "</model></sdf>",
        "no link, joint or frame 'k'",
    ),
    "ball": (
        "<sdf><model name='a'><link name='l'/><joint name='j' type='ball'><parent>world</parent>"
        "<child>l</child></joint></model></sdf>",
        "type 'ball' is not one of",
    ),
    "half a pose": (
        "<sdf><model name='a'><link name='l'><pose>0 0 0</pose></link></model></sdf>",
        "expected 6 numbers",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_makes_no_sense_is_refused_by_place(case: str) -> None:
    text, message = WRONG[case]
    with pytest.raises(DescriptionError, match=message):
        read_sdf(text)
