from __future__ import annotations

import contextlib

import numpy as np
import pytest

from asbuilt.description import ROOT, load_robot
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import DescriptionError, MissingExtraError

mujoco = pytest.importorskip("mujoco")

TREE = """
<mujoco model="tree">
  <compiler angle="degree" autolimits="true"/>
  <option gravity="1 -2 -9"/>
  <default>
    <joint armature="0.1"/>
    <default class="slider">
      <joint type="slide" damping="2"/>
      <geom type="capsule" size="0.04 0.2" density="500"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="stand" pos="0 0 0.5" euler="0 0 30">
      <inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>
      <body name="shoulder" pos="0.1 0 0.2" quat="0.8 0.2 -0.3 0.1">
        <inertial pos="0.1 0.02 0" quat="0.9 0.1 0 0.2" mass="3" diaginertia="0.1 0.2 0.25"/>
        <joint name="swing" axis="0.6 0 0.8" pos="0.02 -0.01 0.03" range="-90 45"
          ref="20" frictionloss="0.3"/>
        <joint name="twist" axis="0 1 0" pos="0.1 0 0"/>
        <body name="bracket" pos="0 0.2 0" euler="90 0 0">
          <inertial pos="0 0 0.1" mass="0.5" diaginertia="0.01 0.01 0.01"/>
          <body name="piston" pos="0 0 0.3" childclass="slider">
            <joint name="push" axis="0 0 -1" range="0 0.3" ref="0.1"/>
            <geom/>
            <site name="tip" pos="0 0 0.2"/>
          </body>
        </body>
      </body>
      <body name="left" pos="0 -0.4 0">
        <joint name="left_hinge" axis="1 0 0"/>
        <geom type="box" size="0.1 0.2 0.3" mass="2"/></body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="left_hinge" gear="50" forcerange="-2 2"/></actuator>
</mujoco>
"""


def test_right_angles_of_ten_digits_are_exact() -> None:
    text = TREE.replace('euler="0 0 30"', 'euler="0 90.00000001 0"')
    before = read_mjcf(text).joints[3].before[:3, :3]
    assert set(np.abs(before).ravel().tolist()) <= {0.0, 1.0}


@pytest.mark.slow
def test_a_tree_with_every_feature_needs_mujocos_torques():
    model = read_mjcf(TREE)
    oracle = mujoco.MjModel.from_xml_string(TREE)
    data = mujoco.MjData(oracle)
    assert model.joint_names == ("swing", "twist", "push", "left_hinge")
    order = [oracle.joint(name).dofadr[0] for name in model.joint_names]
    rng = np.random.default_rng(0)
    for _ in range(10):
        q, qd, qdd = rng.uniform(-1, 1, (3, 4))
        data.qpos[order], data.qvel[order], data.qacc[order] = q, qd, qdd
        mujoco.mj_forward(oracle, data)
        data.qacc[order] = qdd
        tau = np.zeros(4)
        mujoco.mj_rne(oracle, data, 1, tau)
        assert np.allclose(inverse_dynamics(model, q, qd, qdd), tau[order], atol=1e-10)


def test_limits_drives_parts_and_frames_arrive():
    model = read_mjcf(TREE)
    swing, twist, push, left = model.joints
    assert [joint.kind for joint in model.joints] == [
        "revolute",
        "continuous",
        "prismatic",
        "continuous",
    ]
    assert np.allclose([swing.limits.lower, swing.limits.upper], np.deg2rad([-90, 45]))
    assert (swing.drive.armature, swing.drive.coulomb, twist.drive.coulomb, push.drive.viscous) == (
        0.1,
        0.3,
        None,
        2.0,
    )
    assert left.limits.torque == 100.0
    assert model.link_names == ("shoulder_after_swing", "shoulder", "piston", "left")
    assert not model.links[0].inertia.parameters.any()
    assert [name for name, _ in model.links[1].parts] == ["shoulder", "bracket"]
    assert {frame.name: frame.link for frame in model.frames} == {
        "stand": ROOT,
        "bracket": 1,
        "tip": 2,
    }
    assert np.array_equal(model.gravity, [1, -2, -9])


def test_a_model_from_strangers_loads_without_its_meshes(shared):
    path = shared / "models" / "mjcf_iiwa14.xml"
    model = load_robot(path)
    assert model.joint_names == tuple(f"joint{i}" for i in range(1, 8))
    assert [link.inertia.mass for link in model.links] == [5.76, 6.35, 3.5, 3.5, 3.5, 1.8, 1.2]
    assert np.isclose(model.joints[1].limits.upper, 2.0944)
    for joint in model.joints:
        assert set(np.unique(np.abs(joint.before[:3, :3]))) <= {0.0, 1.0}
    urdf = load_robot(shared / "models" / "iiwa14.urdf")
    assert [link.inertia.mass for link in urdf.links] == [link.inertia.mass for link in model.links]


MESHES = """
<mujoco><default><default class="v"><geom type="mesh"/></default></default>
<asset><mesh name="m" file="nowhere.stl"/>
  <texture name="t" type="2d" file="none.png"/>
  <material name="p" texture="t"/></asset>
<worldbody><body name="a" childclass="v"><joint name="j"/>{inertial}
<frame pos="0 0 1"><geom mesh="m" material="p"/>
  <body name="b"><joint name="k" type="slide"/>
  <geom type="sphere" size="0.1" mass="2"/></body></frame>
</body></worldbody></mujoco>
"""


def test_a_body_made_of_meshes_alone_counts_as_unknown():
    model = read_mjcf(MESHES.format(inertial=""))
    assert [link.inertia_known for link in model.links] == [False, True]
    assert not model.links[0].inertia.parameters.any()
    assert "body 'a' has no <inertial>" in model.notes[0]
    assert np.isclose(model.links[1].inertia.mass, 2.0)
    assert model.joints[1].before[2, 3] == 1.0
    known = read_mjcf(
        MESHES.format(inertial='<inertial pos="0 0 0" mass="4" diaginertia="1 1 1"/>')
    )
    assert known.links[0].inertia_known
    assert known.links[0].inertia.mass == 4.0


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            '<body name="x"><freejoint name="f"/><geom size="1"/></body>',
            r"joint 'f' of body 'x' is a free joint",
        ),
        ('<body><joint type="ball"/><geom size="1"/></body>', r"ball joint"),
        ('<body><joint axis="0 0 0"/><geom size="1"/></body>', r"MuJoCo refuses the model: .*axis"),
        ('<body name="x"><geom size="1"/></body>', r"no body has a hinge or slide joint"),
        ('<include file="other.xml"/>', r"includes 'other.xml' and has no folder"),
        (
            '<body><joint/><flexcomp name="f" type="mesh" file="/etc/passwd"/></body>',
            r"holds <flexcomp>.*write its rigid bodies out",
        ),
        ("<body>" * 3000 + "</body>" * 3000, r"nested too deeply"),
    ],
)
def test_what_cannot_be_described_is_refused(body, message):
    with pytest.raises(DescriptionError, match=message):
        read_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


def test_equality_constraints_are_noted():
    text = TREE.replace(
        "</mujoco>", '<equality><joint joint1="swing" joint2="twist"/></equality></mujoco>'
    )
    model = read_mjcf(text)
    (swing,) = model.followers
    assert (swing.name, "swing" in model.joint_names) == ("swing", False)
    assert swing.mimic is not None
    assert swing.mimic.factors == {"twist": 1.0}
    assert any("follows 'twist'" in note for note in model.notes)
    curved = text.replace('joint2="twist"', 'joint2="twist" polycoef="0 1 2 0 0"')
    (loop,) = read_mjcf(curved).loops
    assert loop.kind == "joint"


def test_springs_of_joints_are_noted():
    (note,) = read_mjcf(
        TREE.replace('<joint name="twist"', '<joint name="twist" stiffness="3"')
    ).notes
    assert note.startswith("the springs of twist (stiffness) are left out")
    assert read_mjcf(TREE).notes == ()


def test_without_mujoco_the_extra_is_named(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'asbuilt\[sim\]'"):
        read_mjcf(TREE)


def test_mujocos_warnings_become_notes_and_not_a_log_file(monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    light = (
        '<body><joint name="j"/><inertial pos="0 0 0" mass="1e-8" diaginertia="1e-14 1e-14'
        ' 1e-14"/></body>'
    )
    nan = '<body pos="nan 0 0"><joint/><geom size="1"/></body>'
    for body in (light, nan):
        with contextlib.suppress(DescriptionError):
            read_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


ARM = """<mujocoinclude><body name="arm" pos="0 0 .2"><joint name="j" axis="0 1 0" damping=".3"/>
<geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="2"/>
<include file="parts/hand.xml"/></body></mujocoinclude>"""
HAND = """<mujocoinclude><body name="hand" pos=".3 0 0"><joint name="k" axis="0 0 1"/>
<geom type="box" size=".05 .03 .02" pos=".05 0 0" mass=".4"/></body></mujocoinclude>"""
SCENE = """<mujoco model="scene"><include file="settings.xml"/><worldbody><light pos="0 0 3"/>
<include file="arm.xml"/></worldbody></mujoco>"""


def test_included_files_are_those_of_mujoco(tmp_path):
    (tmp_path / "parts").mkdir()
    settings = '<mujoco><default><joint armature="0.07"/></default></mujoco>'
    for name, text in (("arm.xml", ARM), ("parts/hand.xml", HAND), ("settings.xml", settings)):
        (tmp_path / name).write_text(text)
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    model = load_robot(scene)
    compiled = mujoco.MjModel.from_xml_path(str(scene))
    data = mujoco.MjData(compiled)
    q, qd, qdd = np.random.default_rng(5).uniform(-1.0, 1.0, (3, 20, 2))
    drives = np.array(
        [[joint.drive.armature, joint.drive.viscous or 0.0] for joint in model.joints]
    )
    ours = inverse_dynamics(model, q, qd, qdd) + drives[:, 0] * qdd + drives[:, 1] * qd
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(compiled, data)
        np.testing.assert_allclose(ours[k], data.qfrc_inverse, atol=1e-10)
    assert model.link_names == ("arm", "hand")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "../secret.xml",
            r"includes '../secret.xml', which is no .xml or .mjcf file in the folder",
        ),
        ("/etc/passwd", r"includes '/etc/passwd', which is no .xml"),
        ("link.xml", r"includes 'link.xml', which is no .xml"),
        ("gone.xml", r"includes 'gone.xml', which does not exist"),
        ("scene.xml", r"scene.xml is included again"),
        ("loop.xml", r"loop.xml is included again"),
    ],
)
def test_files_outside_the_folder_and_circles_are_refused(tmp_path, name, message):
    folder = tmp_path / "robot"
    folder.mkdir()
    (tmp_path / "secret.xml").write_text(HAND)
    (folder / "link.xml").symlink_to(tmp_path / "secret.xml")
    (folder / "loop.xml").write_text('<mujocoinclude><include file="loop.xml"/></mujocoinclude>')
    scene = folder / "scene.xml"
    scene.write_text(SCENE.replace("arm.xml", name).replace('<include file="settings.xml"/>', ""))
    with pytest.raises(DescriptionError, match=message):
        load_robot(scene)


def test_meshes_that_are_there_to_be_seen_do_not_hide_the_inertia():
    text = """<mujoco><default><default class="seen"><geom type="mesh" group="2" density="0"/>
    </default></default><asset><mesh name="m" file="nowhere.stl"/></asset>
    <worldbody><body name="a"><joint name="j"/><geom mesh="m" type="mesh" mass="1.5"/>
    <body name="b"><joint name="k" axis="0 1 0"/><geom class="seen" mesh="m"/>
    <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2" mass=".7"/></body>
    <body name="c"><joint name="l" axis="0 1 0"/><geom type="mesh" mesh="m" mass="0"/>
    <geom type="sphere" size=".05" mass=".2"/></body></body></worldbody></mujoco>"""
    model = read_mjcf(text)
    assert [link.inertia_known for link in model.links] == [False, True, True]
    assert [link.inertia.mass for link in model.links[1:]] == pytest.approx([0.7, 0.2])
    (note,) = [note for note in model.notes if "'a'" in note]
    assert "1.5 kg by its geoms" in note


def test_bodies_without_a_name_take_none_of_the_others() -> None:
    text = """<mujoco><worldbody><body>{ball}<body name="body_1" pos="0 0 1"><joint name="a"/>{ball}
    <body pos="0 0 1"><joint name="b" axis="0 1 0"/>{ball}{ball}<body name="body_3">{ball}</body>
    </body></body></body></worldbody></mujoco>""".format(ball='<geom size="0.1"/>')
    model = read_mjcf(text)
    assert model.parents == (ROOT, 0)
    assert model.link_names == ("body_1", "body_3_unnamed")
    assert [frame.name for frame in model.frames] == ["body_1_unnamed", "body_3"]
    ball = 1000.0 * 4.0 / 3.0 * np.pi * 0.1**3
    masses = [link.inertia.mass for link in model.links]
    np.testing.assert_allclose(masses, [ball, 3.0 * ball], rtol=1e-12)
