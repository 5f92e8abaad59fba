"""Robots of the package robot_descriptions, without the network."""

from __future__ import annotations

import sys
from importlib.util import spec_from_file_location
from pathlib import Path

import pytest

from asbuilt.description import load, load_robot
from asbuilt.errors import DescriptionError, MissingExtraError, UsageError

URDF = """<robot name="one"><link name="a"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package robot_descriptions of our own, with one robot and one that cannot be fetched."""
    folder = tmp_path / "robot_descriptions"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "one_description.py").write_text(f"URDF_PATH = {str(tmp_path / 'one.urdf')!r}")
    (folder / "far_description.py").write_text("raise OSError('no route to host')")
    (folder / "bare_description.py").write_text("")
    (tmp_path / "one.urdf").write_text(URDF)
    monkeypatch.syspath_prepend(tmp_path)
    for name in [each for each in sys.modules if each.split(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    location = spec_from_file_location(
        "robot_descriptions", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    monkeypatch.setattr(load, "find_spec", lambda name: location)
    return folder


def test_robot_is_loaded_by_name(package: Path) -> None:
    assert load_robot("one_description").joint_names == ("j",)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("far_description", "cannot be downloaded.*no route to host"),
        ("on_description", "did you mean 'one_description'"),
        ("bare_description", "has no URDF or MJCF"),
    ],
)
def test_what_is_not_there_is_one_error(package: Path, name: str, message: str) -> None:
    with pytest.raises(DescriptionError, match=message):
        load_robot(name)


def test_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="robot_descriptions"):
        load_robot("panda_description")


FLOATING = """<robot name="box"><link name="box"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="arm">
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="hinge" type="revolute"><parent link="box"/><child link="arm"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def test_a_loaded_robot_keeps_its_base_or_says_that_it_cannot(tmp_path: Path) -> None:
    (tmp_path / "box.urdf").write_text(FLOATING)
    floating = load_robot(tmp_path / "box.urdf", base="free")
    fixed = load_robot("two-link")
    assert load_robot(floating, base="free") is floating
    assert load_robot(fixed, fixed_base=True) is fixed
    with pytest.raises(UsageError, match="the base of box floats"):
        load_robot(floating, fixed_base=True)
    with pytest.raises(UsageError, match="two-link is loaded already, on a fixed root"):
        load_robot(fixed, base="free")
    with pytest.raises(UsageError, match="give one"):
        load_robot(tmp_path / "box.urdf", fixed_base=True, base="free")
    assert [contact.frame for contact in load_robot(floating, contacts="arm").contacts] == ["arm"]
