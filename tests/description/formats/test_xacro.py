"""xacro files are expanded by the package xacro; what it refuses is one error."""

from __future__ import annotations

from pathlib import Path

import pytest

from asbuilt.description import load_robot
from asbuilt.description.formats.xacro import read_xacro
from asbuilt.errors import DescriptionError
from asbuilt.untrusted import set_xacro_arguments

ARM = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="length" value="0.4"/>
<xacro:macro name="limb" params="k parent">
  <link name="l${k}"><inertial><origin xyz="${length / 2} 0 0"/><mass value="${2 * k}"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j${k}" type="continuous"><origin xyz="${length} 0 0"/><axis xyz="0 0 1"/>
    <parent link="${parent}"/><child link="l${k}"/></joint>
</xacro:macro>
<link name="floor"/>
<xacro:limb k="1" parent="floor"/><xacro:limb k="2" parent="l1"/>
</robot>"""


def test_macros_and_properties_become_links(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    (tmp_path / "arm.urdf.xacro").write_text(ARM)
    robot = load_robot(tmp_path / "arm.urdf.xacro")
    assert robot.joint_names == ("j1", "j2")
    assert [link.inertia.mass for link in robot.links] == [2.0, 4.0]
    assert robot.links[1].inertia.com[0] == pytest.approx(0.2)


def test_a_robot_on_legs_is_expanded_as_well(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    text = ARM.replace('type="continuous"', """type="${'floating' if k == 1 else 'continuous'}\"""")
    path = tmp_path / "legs.xacro"
    path.write_text(text)
    robot = load_robot(path, base="free")
    assert robot.n_floating == 6
    assert robot.joint_names[6:] == ("j2",)
    assert load_robot(path, fixed_base=True).joint_names == ("j2",)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("length / 2", "unknown / 2"),
        ('<link name="floor"/>', '<xacro:include filename="$(find nowhere)/x.xacro"/>'),
        ("2 * k", "'a' * 10**10"),
    ],
)
def test_what_cannot_be_expanded_is_one_error(tmp_path: Path, old: str, new: str) -> None:
    pytest.importorskip("xacro")
    (tmp_path / "arm.xacro").write_text(ARM.replace(old, new))
    with pytest.raises(DescriptionError, match=r"arm\.xacro: xacro cannot expand it"):
        read_xacro(tmp_path / "arm.xacro")


def test_an_argument_without_a_value_is_named_with_its_option(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    (tmp_path / "arm.xacro").write_text(ARM.replace("2 * k", "$(arg weight)"))
    with pytest.raises(
        DescriptionError, match="argument 'weight', which has no default"
    ) as refused:
        read_xacro(tmp_path / "arm.xacro")
    assert refused.value.cure is not None
    assert refused.value.cure.settings == {"xacro": "weight=VALUE"}


def test_arguments_take_the_place_of_defaults(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    text = ARM.replace(
        '<xacro:property name="length" value="0.4"/>',
        '<xacro:arg name="length" default="0.4"/>'
        '<xacro:property name="length" value="$(arg length)"/>',
    )
    (tmp_path / "arm.xacro").write_text(text)
    with set_xacro_arguments({"length": "0.8"}):
        longer = load_robot(tmp_path / "arm.xacro")
    assert longer.links[1].inertia.com[0] == pytest.approx(0.4)
    assert load_robot(tmp_path / "arm.xacro").links[1].inertia.com[0] == pytest.approx(0.2)


@pytest.mark.parametrize("package", [True, False])
def test_find_looks_around_the_file_and_beside_it(package: bool, tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    root = tmp_path / "my_arm"
    (root / "urdf").mkdir(parents=True)
    if package:
        (root / "package.xml").write_text("<package/>")
        file, shared, name = root / "urdf" / "arm.xacro", root / "sizes.xacro", "my_arm"
    else:
        file, shared, name = root / "arm.xacro", root / "urdf" / "sizes.xacro", "urdf"
    shared.write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:property name="length" value="0.4"/></robot>'
    )
    file.write_text(
        ARM.replace(
            '<xacro:property name="length" value="0.4"/>',
            f'<xacro:include filename="$(find {name})/sizes.xacro"/>',
        )
    )
    assert load_robot(file).joint_names == ("j1", "j2")
