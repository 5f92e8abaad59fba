import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reload_oracle import as_if_identified, pinocchio_torques

from asbuilt.description import DriveValues, LinkInertia, RobotModel
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import DescriptionError, InertiaError
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.urdf_edit import edit_urdf, measure_torque_difference
from shared_urdfs import SHARED_URDFS

ARM = """<?xml version='1.0' encoding='ISO-8859-1'?>\r
<!-- <inertial> in a comment, \xe9, stays -->\r
<robot name="arm">\r
  <link name="base"><inertial><mass value="1"/>\
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>\r
  <link   name = 'upper' >\r
    <inertial>  <!-- CAD -->\r
      <mass   value='2' unit='kg'/>\r
      <origin rpy='0.1 0.2 0.3' xyz='0 0 .1'/>\r
      <inertia ixx='0.02' ixy='0' ixz='0' iyy='0.02' iyz='0' izz='0.01'/>\r
    </inertial>\r
    <visual note="a > b"><geometry><box size="1 1 1"/></geometry></visual>\r
  </link>\r
  <link name="cover"><inertial><origin xyz="0 0.1 0"/><mass value="0.3"/>\
<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial></link>\r
  <link name="lower"/>\r
  <link name="gripper">\r
    <inertial><mass value="0.8"/>\
<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>\r
  </link>\r
  <link name="slider">\r
    <inertial><mass value="0.5"/>\
<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>\r
  </link>\r
  <joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>\
<limit lower="-2" upper="2" effort="9" velocity="2"/>\r
    <dynamics friction="0.1"/></joint>\r
  <joint name="fix" type="fixed"><origin xyz="0 0 0.2" rpy="0.5 0 0"/><parent link="upper"/>\
<child link="cover"/></joint>\r
  <joint name="j2" type="continuous">\r
    <origin xyz="0.1 0 0.4" rpy="1.5707963267948966 0 0.3"/>\r
    <parent link="upper"/>\r
    <child link="lower"/>\r
    <axis xyz="0 0.6 0.8"/>\r
  </joint>\r
  <joint name="grip" type="fixed"><origin xyz="0 0 0.3"/><parent link="lower"/>\
<child link="gripper"/></joint>\r
  <joint name="j3" type="prismatic"><parent link="gripper"/><child link="slider"/>\
<axis xyz="1 0 0"/>\r
    <limit lower="0" upper="0.1" effort="9" velocity="2"/></joint>\r
</robot>\r
"""


def arm_file(folder: Path, text: str = ARM, codec: str = "latin-1") -> Path:
    path = folder / "arm.urdf"
    path.write_bytes(text.encode(codec))
    return path


def without_inertials_and_dynamics(content: bytes) -> bytes:
    """Return the file without the elements that an export may change, found by another way than the
    writer's.
    """
    return re.sub(rb"(?s)\s*<inertial>.*?</inertial>|\s*<dynamics[^>]*/>", b"", content)


def check_reloads(content: bytes, model: RobotModel, *, tolerance: float) -> None:
    q, qd, qdd = draw_sample_states(model, 30)
    expected = inverse_dynamics(model, q, qd, qdd)
    read = read_urdf(content)
    np.testing.assert_allclose(
        inverse_dynamics(read.with_gravity(model.gravity), q, qd, qdd), expected, rtol=0, atol=1e-9
    )
    found = pinocchio_torques(
        re.sub(r"^<\?xml[^>]*>", "", content.decode("latin-1")),
        model.joint_names,
        model.gravity,
        q,
        qd,
        qdd,
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    for joint, there in zip(model.joints, read.joints, strict=True):
        assert there.drive.viscous == joint.drive.viscous
        assert there.drive.coulomb == joint.drive.coulomb


@pytest.mark.parametrize("name", SHARED_URDFS)
def test_descriptions_of_strangers(shared: Path, name: str) -> None:
    path = shared / "models" / name
    original = path.read_bytes()
    model = as_if_identified(read_urdf(path), 1)
    content, notes = edit_urdf(path, model)
    assert without_inertials_and_dynamics(content) == without_inertials_and_dynamics(original)
    assert re.findall(rb"(?s)<!--.*?-->", content) == re.findall(rb"(?s)<!--.*?-->", original)
    reread, literal = (
        measure_torque_difference(model, read_urdf(content, straighten=exact)).max()
        for exact in (True, False)
    )
    assert reread < 1e-9
    check_reloads(content, model, tolerance=1e-9 + 2.0 * literal)
    rounds = any("taken literally" in note for note in notes)
    assert rounds == (literal > 1e-9) == (name in ("ur10.urdf", "ur10e.urdf", "xarm7.urdf"))


@pytest.mark.parametrize("name", SHARED_URDFS)
def test_a_robot_as_described_gives_its_file_back(shared: Path, name: str) -> None:
    path = shared / "models" / name
    assert edit_urdf(path, read_urdf(path))[0] == path.read_bytes()


def test_small_arm_with_every_habit(tmp_path: Path) -> None:
    path = arm_file(tmp_path)
    described = read_urdf(path)
    assert [part for part, _ in described.links[0].parts] == ["upper", "cover"]
    model = as_if_identified(described, 2)
    content, notes = edit_urdf(path, model)
    assert not any("removed" in note for note in notes)
    check_reloads(content, model, tolerance=1e-9)
    assert "\xe9, stays".encode("latin-1") in content
    assert b"<mass   value='2' " not in content
    assert b"unit='kg'/>" in content
    assert b'<dynamics friction="' in content
    assert content.count(b"\n") == content.count(b"\r\n")
    assert b'<link name="cover"><inertial><origin xyz="0 0.1 0"/>' in content
    assert b'<link name="lower">\r\n    <inertial><origin xyz="' in content
    assert "no place for the armature of the drives" in notes[0]
    assert f"j2 {model.joints[1].drive.offset:.6g}" in notes[1]
    stripped = without_inertials_and_dynamics(ARM.encode("latin-1")).replace(
        b'<link name="lower"/>', b'<link name="lower">\r\n  </link>'
    )
    assert without_inertials_and_dynamics(content) == stripped


def test_remarks_end_no_comment(tmp_path: Path) -> None:
    path = arm_file(tmp_path)
    model = as_if_identified(read_urdf(path), 2)
    content, _ = edit_urdf(path, model, remarks=("a ---> <b/>", "c --"))
    assert b"<!-- a - - -> <b/> -->" in content
    check_reloads(content, model, tolerance=1e-9)


def test_utf_16_stays_utf_16(tmp_path: Path) -> None:
    text = ARM.replace("ISO-8859-1", "UTF-16")
    path = arm_file(tmp_path, text, "utf-16")
    model = as_if_identified(read_urdf(path), 2)
    content, _ = edit_urdf(path, model)
    narrow, _ = edit_urdf(arm_file(tmp_path), model)
    assert content == narrow.decode("latin-1").replace("ISO-8859-1", "UTF-16").encode("utf-16")


def test_inertia_of_fixed_parts_moves_where_the_remainder_is_impossible(tmp_path: Path) -> None:
    path = arm_file(tmp_path)
    described = read_urdf(path)
    small = LinkInertia.from_com(0.2, [0.0, 0.0, 0.1], np.diag([1e-3, 1e-3, 1e-3]))
    model = replace(
        described,
        links=(replace(described.links[0], inertia=small, parts=()), *described.links[1:]),
    )
    content, notes = edit_urdf(path, model)
    assert b'<link name="cover"></link>' in content
    assert "of cover were removed" in notes[0]
    check_reloads(content, model, tolerance=1e-9)


def test_tilted_gravity_is_said(tmp_path: Path) -> None:
    path = arm_file(tmp_path)
    model = as_if_identified(read_urdf(path), 3).with_gravity([1.0, 0.0, -9.7])
    content, notes = edit_urdf(path, model)
    assert any("gravity" in note and "(1, 0, -9.7)" in note for note in notes)
    check_reloads(content, model, tolerance=1e-9)


def test_another_robot_is_refused(tmp_path: Path) -> None:
    path = arm_file(tmp_path)
    model = read_urdf(path)
    moved = arm_file(tmp_path, ARM.replace("0.1 0 0.4", "0.1 0 0.5"))
    with pytest.raises(DescriptionError, match=r"placement of joint 'j2' differs by 0\.0?[19]"):
        edit_urdf(moved, model)
    with pytest.raises(DescriptionError, match="joints are j1, j2, other"):
        edit_urdf(arm_file(tmp_path, ARM.replace('"j3"', '"other"')), model)
    with pytest.raises(DescriptionError, match="moving links are"):
        edit_urdf(arm_file(tmp_path, ARM.replace('"slider"', '"pusher"')), model)
    with pytest.raises(DescriptionError, match="j3' is revolute"):
        edit_urdf(arm_file(tmp_path, ARM.replace('"prismatic"', '"revolute"')), model)
    with pytest.raises(DescriptionError, match="cannot be read"):
        edit_urdf(tmp_path / "nowhere.urdf", model)


def test_impossible_models_are_refused(tmp_path: Path) -> None:
    path = arm_file(tmp_path)
    model = read_urdf(path)
    flat = LinkInertia.from_com(1.0, np.zeros(3), np.diag([0.1, 0.1, 0.3]))
    with pytest.raises(InertiaError, match=r"link 3: Ixx \+ Iyy < Izz by 0\.1 kg m\^2"):
        edit_urdf(
            path, replace(model, links=(*model.links[:2], replace(model.links[2], inertia=flat)))
        )
    pushing = replace(model.joints[1], drive=DriveValues(viscous=-0.5))
    with pytest.raises(InertiaError, match=r"joint 2: viscous friction is -0\.5"):
        edit_urdf(path, replace(model, joints=(model.joints[0], pushing, model.joints[2])))
