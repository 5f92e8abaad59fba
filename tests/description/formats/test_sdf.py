"""SDF against URDF: the same robots with poses in the model's frame have the same dynamics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import (
    RobotModel,
    bundled_robot,
    load_robot,
    rotation_from_rpy,
    rpy_from_rotation,
)
from asbuilt.description.formats.sdf import read_sdf
from asbuilt.dynamics import inverse_dynamics, link_poses
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
    "name of the model's frame": (
        "<sdf><model name='a'><link name='__model__'/></model></sdf>",
        "a <link> has no name of its own \\('__model__'\\)",
    ),
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
    "a joint as a child": (
        "<sdf><model name='a'><link name='l'/><joint name='j' type='revolute'>"
        "<parent>world</parent><child>l</child><axis/></joint><joint name='k' type='revolute'>"
        "<parent>l</parent><child>j</child><axis/></joint></model></sdf>",
        "joint 'k': the child link 'j' does not exist",
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


FRAMES = """<sdf version="1.9"><model name="f">
<link name="base"/><joint name="fix" type="fixed"><parent>world</parent><child>base</child></joint>
<frame name="away"><pose>0 0 1 0 0 0</pose></frame>
<frame name="mount" attached_to="base"><pose>0.1 0 0.2 0 0.5 0</pose></frame>
<link name="left arm"><pose relative_to="mount">0 0 0.3 0 0 0</pose><inertial>{pose}<mass>1</mass>
<inertia><ixx>.02</ixx><iyy>.02</iyy><izz>.02</izz></inertia></inertial></link>
<joint name="j 1" type="revolute"><parent>{parent}</parent><child>left arm</child>
<axis><xyz>0 1 0</xyz><limit><lower>{lower}</lower><upper>{upper}</upper></limit>{more}</axis>
</joint>
</model></sdf>"""


def frames(
    parent: str = "base",
    pose: str = "<pose>0.2 0 0 0 0 0</pose>",
    limits: tuple[str, str] = ("-1", "1"),
    more: str = "",
) -> RobotModel:
    lower, upper = limits
    text = FRAMES.format(parent=parent, pose=pose, lower=lower, upper=upper, more=more)
    return read_sdf(text)


def test_a_parent_may_be_a_frame():
    plain, framed = frames(), frames(parent="mount")
    np.testing.assert_array_equal(plain.joints[0].before, framed.joints[0].before)
    assert plain.link_names == ("left arm",)
    assert plain.joint_names == ("j 1",)


def test_the_centre_of_mass_may_be_relative_to_a_frame():
    # The arm stands at mount * (0, 0, 0.3); the centre is 0.5 before the frame "away".
    found = frames(pose='<pose relative_to="away">0.5 0 0 0 0 0</pose>')
    arm = np.eye(4)
    arm[:3, :3] = rotation_from_rpy([0.0, 0.5, 0.0])
    arm[:3, 3] = np.array([0.1, 0, 0.2]) + arm[:3, :3] @ [0, 0, 0.3]
    expected = np.linalg.solve(arm, [0.5, 0.0, 1.0, 1.0])[:3]
    np.testing.assert_allclose(found.links[0].inertia.com, expected, atol=1e-12)


@pytest.mark.parametrize("most", ["1.79769e+308", "1e16", "inf", "1.7976931348623157e308"])
def test_the_largest_number_is_no_limit(most):
    limits = frames(limits=(f"-{most}", most)).joints[0].limits
    assert (limits.lower, limits.upper) == (-np.inf, np.inf)
    assert not frames(limits=(f"-{most}", most)).notes
    one_sided = frames(limits=("-1", most)).joints[0].limits
    assert (one_sided.lower, one_sided.upper) == (-1.0, np.inf)


def test_what_is_not_read_is_named():
    spring = "<dynamics><spring_stiffness>3</spring_stiffness></dynamics>"
    assert frames(more=spring).notes == ("not read of SDF: springs of joints",)


def test_frames_in_a_circle_are_refused():
    text = FRAMES.replace('attached_to="base"', 'attached_to="turn"').replace(
        '<link name="left', '<frame name="turn" attached_to="mount"/><link name="left'
    )
    with pytest.raises(DescriptionError, match="in a circle"):
        read_sdf(text.format(parent="mount", pose="", lower=-1, upper=1, more=""))


def test_links_keep_their_names_where_joints_have_frames_of_their_own():
    text = """<sdf version="1.9"><model name="m"><link name="base"/>
    <joint name="fix" type="fixed"><parent>world</parent><child>base</child></joint>
    <link name="a"><pose>0 0 .5 0 0 0</pose><inertial><pose>.1 0 0 0 0 0</pose><mass>2</mass>
    <inertia><ixx>.01</ixx><iyy>.02</iyy><izz>.02</izz></inertia></inertial></link>
    <joint name="j" type="revolute"><pose>0 .03 -.1 0 0 .2</pose><parent>base</parent>
    <child>a</child><axis><xyz>0 1 0</xyz></axis></joint>
    <link name="b"><pose relative_to="k">0 0 .02 .3 0 0</pose><inertial><mass>1</mass>
    <inertia><ixx>.003</ixx><iyy>.004</iyy><izz>.005</izz></inertia></inertial></link>
    <joint name="k" type="revolute"><pose relative_to="a">.3 0 0 0 .4 0</pose>
    <parent>a</parent><child>b</child><axis><xyz>0 0 1</xyz></axis></joint></model></sdf>"""
    model = read_sdf(text)
    assert model.link_names == ("a", "b")
    assert [link.inertia.mass for link in model.links] == [2.0, 1.0]
    np.testing.assert_allclose(model.links[0].inertia.com, [0.1, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        np.diag(model.links[1].inertia.inertia_about_com), [0.003, 0.004, 0.005], atol=1e-12
    )
    pin = pytest.importorskip("pinocchio")

    def frame(xyz: list[float], rpy: list[float]) -> object:
        return pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))

    other = pin.Model()
    j_in_a = frame([0.0, 0.03, -0.1], [0.0, 0.0, 0.2])
    j = other.addJoint(0, pin.JointModelRY(), frame([0.0, 0.03, 0.4], [0.0, 0.0, 0.2]), "j")
    body = pin.Inertia(2.0, np.array([0.1, 0.0, 0.0]), np.diag([0.01, 0.02, 0.02]))
    other.appendBodyToJoint(j, body, j_in_a.inverse())
    k_in_a = frame([0.3, 0.0, 0.0], [0.0, 0.4, 0.0])
    k = other.addJoint(j, pin.JointModelRZ(), j_in_a.inverse() * k_in_a, "k")
    body = pin.Inertia(1.0, np.zeros(3), np.diag([0.003, 0.004, 0.005]))
    other.appendBodyToJoint(k, body, frame([0.0, 0.0, 0.02], [0.3, 0.0, 0.0]))
    data = other.createData()
    for q, qd, qdd in np.random.default_rng(3).uniform(-1.0, 1.0, (5, 3, 2)):
        ours = inverse_dynamics(model, q[None], qd[None], qdd[None])[0]
        np.testing.assert_allclose(ours, pin.rnea(other, data, q, qd, qdd), atol=1e-10)
