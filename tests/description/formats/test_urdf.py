from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from asbuilt.description import ROOT, RobotModel, load_robot
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.rotation import round_to_right_angle
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import DescriptionError
from shared_urdfs import SHARED_URDFS


def straightened_text(text: str) -> str:
    def replace(match: re.Match[str]) -> str:
        return (
            'rpy="'
            + " ".join(repr(round_to_right_angle(float(angle))) for angle in match[1].split())
            + '"'
        )

    return re.sub(r'rpy="([^"]*)"', replace, text)


def random_urdf(seed: int, n: int = 12) -> str:
    rng = np.random.default_rng(seed)
    text = '<robot name="random"><link name="link0"/>'
    for i in range(1, n + 1):
        A = rng.normal(size=(3, 3))
        I = A @ A.T
        I = np.trace(I) * np.eye(3) - I
        tensor = " ".join(
            f'i{a}{b}="{I["xyz".index(a), "xyz".index(b)]!r}"'.replace("np.float64(", "").replace(
                ")", ""
            )
            for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        kind = (
            "revolute"
            if i == 1
            else rng.choice(["revolute", "prismatic", "continuous", "fixed", "fixed"])
        )
        axis = rng.choice(["0 0 1", "0 0 -1", "1 0 0", "0 -1 0", "0.6 0 0.8"])
        inertial = (
            f'<inertial><origin xyz="{row(rng)}" rpy="{row(rng)}"/><mass'
            f' value="{rng.uniform(0.1, 5)}"/><inertia {tensor}/></inertial>'
        )
        text += f'<link name="link{i}">{inertial if rng.random() < 0.8 else ""}</link>'
        text += (
            f'<joint name="joint{i}" type="{kind}"><origin xyz="{row(rng)}" rpy="{row(rng)}"/><axis'
            f' xyz="{axis}"/><parent link="link{rng.integers(0, i)}"/><child link="link{i}"/><limit'
            ' lower="-1" upper="1" effort="5" velocity="2"/></joint>'
        )
    return text + "</robot>"


def row(rng: np.random.Generator) -> str:
    return " ".join(repr(float(x)) for x in rng.uniform(-1, 1, 3))


def agrees_with_pinocchio(model: RobotModel, text: str) -> None:
    oracle = pin.buildModelFromXML(straightened_text(text))
    assert set(model.joint_names) == set(oracle.names[1:])
    for i, joint in enumerate(model.joints):
        k = oracle.getJointId(joint.name)
        above = "universe" if joint.parent == ROOT else model.joints[joint.parent].name
        assert oracle.names[oracle.parents[k]] == above
        assert np.allclose(
            (joint.before @ joint.after), oracle.jointPlacements[k].homogeneous, atol=1e-12
        )
        assert np.allclose(
            model.links[i].inertia.to_pinocchio_order(),
            oracle.inertias[k].toDynamicParameters(),
            atol=1e-11,
        )
    for frame in model.frames:
        found = oracle.frames[oracle.getFrameId(frame.name)]
        assert oracle.names[found.parentJoint] == (
            "universe" if frame.link == ROOT else model.joints[frame.link].name
        )
        assert np.allclose(found.placement.homogeneous, frame.placement, atol=1e-12)
    assert np.isclose(
        sum(link.inertia.mass for link in model.links),
        sum(inertia.mass for inertia in oracle.inertias[1:]),
    )
    rng = np.random.default_rng(0)
    data = oracle.createData()
    order = [oracle.joints[oracle.getJointId(name)].idx_v for name in model.joint_names]
    for _ in range(3):
        q, qd, qdd = rng.uniform(-1, 1, (3, model.n_joints))
        there = np.zeros((3, oracle.nv))
        there[:, order] = q, qd, qdd
        tau = pin.rnea(
            oracle, data, pin.integrate(oracle, pin.neutral(oracle), there[0]), there[1], there[2]
        )
        assert np.allclose(inverse_dynamics(model, q, qd, qdd), tau[order], rtol=1e-10, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHARED_URDFS)
def test_descriptions_from_strangers_agree_with_pinocchio(shared, name):
    path = shared / "models" / name
    text = path.read_text().replace(
        '<origin rpy="0 0 0" xyz="-0.25 0 1"/>\n    <origin rpy="0 0 0" xyz="0 0 0"/>',
        '<origin xyz="-0.25 0 1"/>',
    )
    agrees_with_pinocchio(load_robot(path), text)


@pytest.mark.parametrize("seed", range(8))
def test_random_trees_with_fixed_joints_agree_with_pinocchio(seed):
    text = random_urdf(seed)
    agrees_with_pinocchio(read_urdf(text), text)


LINK = (
    '<link name="{}"><inertial><mass value="2"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1"'
    ' iyz="0" izz="0.1"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 0'
    ' 1"/><limit lower="-1" upper="2" effort="7" velocity="3"/></joint>'
)


def two_links(extra: str = "", joint: str = JOINT.format("j1", "base", "arm")) -> str:
    return f'<robot name="r"><link name="base"/>{LINK.format("arm")}{joint}{extra}</robot>'


def test_limits_drives_and_names_are_kept():
    joint = JOINT.format("j1", "base", "arm").replace(
        "</joint>", '<dynamics damping="0.5" friction="0.2"/></joint>'
    )
    model = read_urdf(two_links(joint=joint))
    limits, drive = model.joints[0].limits, model.joints[0].drive
    assert (limits.lower, limits.upper, limits.torque, limits.velocity, limits.acceleration) == (
        -1.0,
        2.0,
        7.0,
        3.0,
        np.inf,
    )
    assert (drive.viscous, drive.coulomb, drive.armature, drive.offset) == (0.5, 0.2, None, None)
    assert (model.name, model.root_link, model.link_names) == ("r", "base", ("arm",))
    assert read_urdf(two_links()).joints[0].drive.viscous is None


def test_fixed_links_become_parts_and_frames():
    tool = (
        LINK.format("tool")
        + '<joint name="weld" type="fixed"><origin xyz="0 0 1"/><parent link="arm"/><child'
        ' link="tool"/></joint>'
    )
    flange = (
        '<link name="tip"/><joint name="weld2" type="fixed"><origin xyz="0 0 0.5"/><parent'
        ' link="tool"/><child link="tip"/></joint>'
    )
    stand = (
        LINK.format("stand")
        + '<joint name="weld3" type="fixed"><parent link="base"/><child link="stand"/></joint>'
    )
    model = read_urdf(two_links(tool + flange + stand))
    arm = model.links[0]
    assert [name for name, _ in arm.parts] == ["arm", "tool"]
    assert arm.inertia.mass == 4.0
    assert np.isclose(arm.inertia.inertia[0, 0], 0.1 + 0.1 + 2.0 * 1.0**2)
    assert np.allclose(sum(part.parameters for _, part in arm.parts), arm.inertia.parameters)
    assert {frame.name: (frame.link, frame.placement[2, 3]) for frame in model.frames} == {
        "tool": (0, 1.0),
        "tip": (0, 1.5),
        "stand": (ROOT, 0.0),
    }


def test_a_link_without_inertial_is_marked():
    text = two_links('<link name="bare"/>' + JOINT.format("j2", "arm", "bare"))
    model = read_urdf(text)
    assert [link.inertia_known for link in model.links] == [True, False]
    assert not model.links[1].inertia.parameters.any()


def test_rounded_right_angles_become_exact_and_are_noted():
    joint = JOINT.format("j1", "base", "arm").replace(
        "<axis", '<origin rpy="1.5708 0 -3.14159"/><axis'
    )
    model = read_urdf(two_links(joint=joint))
    assert set(np.unique(np.abs(model.joints[0].before[:3, :3]))) == {0.0, 1.0}
    assert sum("right angle" in note for note in model.notes) == 2
    thrice = joint.replace("1.5708 0 -3.14159", "1.5708 1.5708 -3.14159")
    (note,) = read_urdf(two_links(joint=thrice)).notes
    assert (
        note
        == "roll of joint 'j1' is given as 1.5708 rad and taken as the right angle 1.570796327; so"
        " are 2 more angles of this description"
    )
    precise = JOINT.format("j1", "base", "arm").replace(
        "<axis", '<origin rpy="1.570796326794897 0 0.3"/><axis'
    )
    assert not read_urdf(two_links(joint=precise)).notes


def test_an_axis_of_another_length_is_scaled_with_a_note():
    model = read_urdf(two_links(joint=JOINT.format("j1", "base", "arm").replace("0 0 1", "0 3 0")))
    assert "has length 3 and is scaled to 1" in model.notes[0]
    assert np.array_equal(model.joints[0].before[:3, 2], [0, 1, 0])


def test_meshes_need_not_be_there():
    mesh = (
        '<link name="arm"><visual><geometry><mesh'
        ' filename="package://nowhere/arm.dae"/></geometry></visual>'
    )
    assert read_urdf(two_links().replace('<link name="arm">', mesh)).n_joints == 1


BOMB = (
    "<!DOCTYPE b ["
    + '<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    + "]><robot name='&a11;'/>"
)
FLOATING = JOINT.format("j1", "base", "arm").replace("revolute", "floating")
MIMIC = JOINT.format("j1", "base", "arm").replace("</joint>", '<mimic joint="other"/></joint>')


def test_xml_in_any_encoding_is_recognised_by_content(tmp_path: Path) -> None:
    text = (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous"><parent'
        ' link="a"/><child link="b"/></joint></robot>'
    )
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / "arm.urdf").write_text(text, encoding=encoding)
        assert load_robot(tmp_path / "arm.urdf").joint_names == ("j",)


HOSTILE = {
    "expansion bomb": (BOMB, r"declares or refers to entities.*remove them"),
    "external entity": (
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
        r"declares or refers to entities",
    ),
    "external DTD": (
        '<!DOCTYPE robot SYSTEM "http://example.org/x.dtd"><robot name="r"/>',
        r"external reference|no <link>|declares or refers",
    ),
    "broken XML": ("<robot><link name='a'>", r"not well-formed XML.*line 1"),
    "empty": ("<robot/>", r"has no <link>"),
    "not a robot": ("<html><body/></html>", r"outermost element is <html>"),
    "no moving joint": ('<robot name="r"><link name="a"/></robot>', r"no joint moves"),
    "xacro element": (
        two_links('<xacro:arm xmlns:xacro="http://ros.org/wiki/xacro"/>'),
        r"<xacro:arm>.*not expanded.*xacro FILE",
    ),
    "xacro expression": (
        two_links().replace('value="2"', 'value="${m}"'),
        r"value='\$\{m\}'.*not expanded",
    ),
    "nameless link": (two_links("<link/>"), r"link number 3: <link> has no name"),
    "missing mass": (
        two_links().replace('<mass value="2"/>', ""),
        r"link 'arm', inertial: <mass> is missing",
    ),
    "missing moment": (
        two_links().replace('iyy="0.1"', ""),
        r"link 'arm', inertial: <inertia> has no iyy; add iyy",
    ),
    "NaN mass": (
        two_links().replace('value="2"', 'value="nan"'),
        r"value of <mass> is nan; it must be finite",
    ),
    "word for mass": (
        two_links().replace('value="2"', 'value="heavy"'),
        r"value of <mass> is 'heavy'; it must be a number",
    ),
    "two numbers in xyz": (
        two_links().replace('xyz="0 0 1"', 'xyz="0 1"'),
        r"joint 'j1': xyz of <axis> is '0 1'; expected 3 numbers",
    ),
    "infinite axis": (
        two_links().replace('xyz="0 0 1"', 'xyz="0 0 inf"'),
        r"xyz of <axis> is inf; it must be finite",
    ),
    "axis of length zero": (
        two_links().replace('xyz="0 0 1"', 'xyz="0 0 0"'),
        r"joint 'j1': the axis is \[0.0, 0.0, 0.0\].*give a unit vector",
    ),
    "two links of one name": (two_links(LINK.format("arm")), r"two links are named 'arm'"),
    "two joints of one name": (
        two_links(LINK.format("b") + JOINT.format("j1", "arm", "b")),
        r"two joints are named 'j1'",
    ),
    "unknown parent": (
        two_links(joint=JOINT.format("j1", "bas", "arm")),
        r"the parent link 'bas' does not exist \(did you mean 'base'\?\)",
    ),
    "no child": (
        two_links().replace('<child link="arm"/>', ""),
        r"joint 'j1': <child link=...> is missing",
    ),
    "two roots": (
        two_links(LINK.format("lost")),
        r"2 links have no parent joint \('base', 'lost'\)",
    ),
    "loop without root": (
        two_links(JOINT.format("j2", "arm", "base")),
        r"every link is the child of a joint.*loop",
    ),
    "loop beside the root": (
        two_links(
            LINK.format("a")
            + LINK.format("b")
            + JOINT.format("j2", "a", "b")
            + JOINT.format("j3", "b", "a")
        ),
        r"link 'a' cannot be reached.*loop",
    ),
    "two parents": (
        two_links(
            LINK.format("b") + JOINT.format("j2", "base", "b") + JOINT.format("j3", "arm", "b")
        ),
        r"link 'b' is the child of joint 'j2' and",
    ),
    "self": (two_links(joint=JOINT.format("j1", "arm", "arm")), r"connects link 'arm' with itself"),
    "floating": (two_links(joint=FLOATING), r"joint 'j1': type is 'floating'.*replace it"),
    "planar": (two_links(joint=FLOATING.replace("floating", "planar")), r"type is 'planar'"),
    "unheard of type": (
        two_links(joint=FLOATING.replace("floating", "hinge")),
        r"type is 'hinge'; it must be revolute",
    ),
    "mimic": (
        two_links(joint=MIMIC),
        r"joint 'j1' mimics 'other', which does not exist; the joints are j1",
    ),
    "mimic of itself": (
        two_links(joint=MIMIC.replace("other", "j1")),
        r"joint 'j1' mimics itself",
    ),
    "crossed limits": (
        two_links().replace('lower="-1"', 'lower="5"'),
        r"lower limit 5.0 exceeds upper limit 2.0",
    ),
    "negative effort": (
        two_links().replace('effort="7"', 'effort="-7"'),
        r"effort limit is -7.0; it must be positive",
    ),
    "negative damping": (
        two_links().replace("<limit", '<dynamics damping="-1"/><limit'),
        r"damping is -1.0; it must not be negative",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_descriptions_fail_once_and_clearly(case):
    from asbuilt.errors import DescriptionError

    text, message = HOSTILE[case]
    with pytest.raises(DescriptionError, match=message) as caught:
        read_urdf(text)
    assert caught.value.__cause__ is None


def test_errors_name_the_file(tmp_path):
    path = tmp_path / "broken.urdf"
    path.write_bytes(b"\xff\xfe<robot")
    with pytest.raises(ValueError, match=r"broken\.urdf"):
        read_urdf(path)
    with pytest.raises(ValueError, match=r"absent\.urdf cannot be read"):
        read_urdf(tmp_path / "absent.urdf")


def test_a_thousand_fixed_links_in_a_row_are_no_trouble():
    text = two_links()[: -len("</robot>")]
    above = "arm"
    for i in range(1000):
        text += (
            LINK.format(f"f{i}") + f'<joint name="w{i}" type="fixed"><parent link="{above}"/><child'
            f' link="f{i}"/></joint>'
        )
        above = f"f{i}"
    model = read_urdf(text + "</robot>")
    assert np.isclose(model.links[0].inertia.mass, 2002.0)


GEARED = """<robot name="r"><link name="w"/><link name="a"><inertial><mass value="3"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
<joint name="j" type="revolute"><parent link="w"/><child link="a"/>
<limit lower="0" upper="0" effort="0" velocity="0"/></joint>
<transmission name="t"><joint name="j"/>{second}<actuator name="m">{motor}</actuator></transmission>
</robot>"""
ROS = "<mechanicalReduction>-101</mechanicalReduction><motorInertia>5e-5</motorInertia>"
DRAKE = '<drake:gear_ratio value="101"/><drake:rotor_inertia value="5e-5"/>'


@pytest.mark.parametrize("motor", [ROS, DRAKE])
def test_a_transmission_gives_the_armature(motor):
    text = GEARED.format(motor=motor, second="").replace(
        "<robot ", '<robot xmlns:drake="http://drake.mit.edu" '
    )
    model = read_urdf(text)
    assert model.joints[0].drive.armature == pytest.approx(5e-5 * 101**2)
    assert model.joints[0].drive.gear_ratio == 101.0
    assert any("make the armature 0.5101" in note for note in model.notes)


def test_a_rotor_of_two_joints_is_left_out_with_a_note():
    model = read_urdf(GEARED.format(motor=ROS, second='<joint name="other"/>'))
    assert model.joints[0].drive.armature is None
    assert any("belongs to no single moving joint" in note for note in model.notes)


def test_position_limits_of_zero_are_not_stated():
    model = read_urdf(GEARED.format(motor="", second=""))
    assert (model.joints[0].limits.lower, model.joints[0].limits.upper) == (-np.inf, np.inf)
    assert any("position" in note and "taken as not stated" in note for note in model.notes)


def test_a_rotor_with_negative_inertia_is_refused():
    with pytest.raises(DescriptionError, match="motorInertia> is -1"):
        read_urdf(GEARED.format(motor="<motorInertia>-1</motorInertia>", second=""))
