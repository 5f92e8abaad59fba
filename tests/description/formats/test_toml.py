from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import ROOT, placement, rotation_from_rpy
from asbuilt.description.formats.toml import read_robot_toml, robot_from_toml
from asbuilt.description.lengths import evaluate_lengths, parse_length
from asbuilt.description.rotation import rotation_z
from asbuilt.errors import DescriptionError

ARM = """
name = "arm"
citation = "nobody, 2000"
gravity = [0, 9.81, 0]
root_link = "wall"
angle_unit = "deg"
notes = ["as drawn"]

[lengths]
L1 = 0.4
L2 = 0.25

[[links]]
name = "upper"
joint = "shoulder"
origin = { xyz = ["L1", 0.1, "0.5*L1 - L2"], rpy = [90, 0, 0] }
axis = [0, 0, -2]
mass = 3.0
com = [0.1, 0, 0]
inertia_about_com = { Ixx = 0.1, Iyy = 0.2, Izz = 0.2, Ixy = 0.01 }
limits = { lower = -90, upper = 90, velocity = 180, acceleration = 360, jerk = 720, torque = 50 }
drive = { armature = 0.2, viscous = 1.5, coulomb = 0.7, offset = -0.1 }

[[links]]
name = "slide"
kind = "prismatic"
origin = { xyz = [0, 0, "-L2"] }
after = { xyz = ["L2", 0, 0], rotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]] }
limits = { lower = 0, upper = 0.3, velocity = 1.0, torque = 80 }
parts = [
  { name = "rod", mass = 1.0, com = [0, 0, 0.2], \
    inertia_about_com = { Ixx = 0.02, Iyy = 0.02, Izz = 0.001 } },
  { name = "gripper", mass = 0.5, first_moment = [0, 0, 0.2], \
    inertia_about_origin = { Ixx = 0.09, Iyy = 0.09, Izz = 0.001 } },
]

[[links]]
name = "other_arm"
parent = "wall"
origin = {}

[[frames]]
name = "flange"
link = "slide"
xyz = [0, 0, "L1"]
"""


def test_every_field_arrives():
    model = robot_from_toml(ARM)
    assert (model.name, model.citation, model.root_link, model.notes) == (
        "arm",
        "nobody, 2000",
        "wall",
        ("as drawn",),
    )
    assert np.array_equal(model.gravity, [0, 9.81, 0])
    assert model.parents == (ROOT, 0, ROOT)
    assert model.joint_names == ("shoulder", "joint_2", "joint_3")
    shoulder, slide, other = model.joints
    q = 0.4
    axis = rotation_from_rpy([np.pi / 2, 0, 0]) @ rotation_z(-q)
    assert np.allclose(
        (shoulder.before @ placement(rotation_z(q)) @ shoulder.after)[:3, :3], axis, atol=1e-15
    )
    assert np.allclose(shoulder.before[:3, 3], [0.4, 0.1, -0.05])
    assert np.allclose(
        [shoulder.limits.lower, shoulder.limits.velocity, shoulder.limits.jerk],
        np.deg2rad([-90, 180, 720]),
    )
    assert (shoulder.limits.torque, shoulder.drive.viscous, shoulder.drive.offset) == (
        50.0,
        1.5,
        -0.1,
    )
    assert (slide.limits.upper, slide.limits.velocity, slide.limits.acceleration) == (
        0.3,
        1.0,
        np.inf,
    )
    assert np.array_equal(other.before, np.eye(4))
    assert [link.inertia_known for link in model.links] == [True, True, False]
    assert [name for name, _ in model.links[1].parts] == ["rod", "gripper"]
    assert np.isclose(model.links[1].inertia.mass, 1.5)
    assert np.allclose(model.links[1].inertia.inertia[0, 0], 0.02 + 0.04 + 0.09)
    assert model.links[0].inertia.inertia_about_com[0, 1] == 0.01
    assert model.frames[0].placement[2, 3] == 0.4


def test_named_lengths_become_symbols_and_numbers_beside_them_get_one():
    model = robot_from_toml(ARM)
    assert dict(model.lengths) == {"L1": 0.4, "L2": 0.25, "y1": 0.1}
    for joint in model.joints[:2]:
        for symbols, T in (
            (joint.before_symbols, joint.before),
            (joint.after_symbols, joint.after),
        ):
            if symbols is not None:
                assert np.allclose(evaluate_lengths(symbols, model.lengths), T[:3, 3], atol=1e-16)
    assert model.joints[0].before_symbols == (
        ((1.0, "L1"),),
        ((1.0, "y1"),),
        ((0.5, "L1"), (-1.0, "L2")),
    )
    assert model.joints[1].after_symbols == (((1.0, "L2"),), (), ())
    assert model.joints[2].before_symbols is None


def test_dh_rows_may_stand_on_a_named_origin():
    text = """
    name = "tall"
    convention = "modified"
    [lengths]
    H = 0.8
    [[links]]
    name = "one"
    origin = { xyz = [0, 0, "H"] }
    dh = { d = 0.2 }
    """
    model = robot_from_toml(text)
    assert model.joints[0].before_symbols == ((), (), ((1.0, "H"), (1.0, "b1")))
    assert np.isclose(model.joints[0].before[2, 3], 1.0)


@pytest.mark.parametrize(
    "text", ["L3", "2 L1", "L1 L2", "L1 +", "", "1.5", "L1*2", "__import__('os')"]
)
def test_lengths_are_sums_and_nothing_else(text):
    with pytest.raises(DescriptionError, match="length"):
        parse_length(text, {"L1": 1.0, "L2": 2.0})


def link(fields: str) -> str:
    return f'name = "r"\nconvention = "standard"\n[[links]]\nname = "a"\n{fields}\n'


BROKEN = {
    "not TOML": ("name = \n", r"not valid TOML.*line 1"),
    "no links": ('name = "r"', r"links: is missing"),
    "empty links": ('name = "r"\nlinks = []', r"links: Tuple should have at least 1 item"),
    "no name": ("[[links]]\nname = 'a'\norigin = {}", r"name: is missing"),
    "misspelt field": (
        link("dh = {}\nmas = 3"),
        r"links\[1\] 'a'\.mas: is not a field of this table",
    ),
    "misspelt DH": (link("dh = { r = 1 }"), r"links\[1\] 'a'\.dh\.r: is not a field"),
    "word for number": (
        link('dh = { a = "long" }'),
        r"links\[1\] 'a'\.dh\.a: .*valid number.*got 'long'",
    ),
    "NaN": (link("dh = { a = nan }"), r"dh\.a: .*finite number, got nan"),
    "NaN in xyz": (link("origin = { xyz = [0, nan, 0] }"), r"origin: xyz must be finite"),
    "no geometry": (link("limits = {}"), r"the link has no geometry: give dh"),
    "two geometries": (link("dh = {}\naxis = [0, 0, 1]"), r"placed by dh takes no axis"),
    "no convention": (
        'name = "r"\n[[links]]\nname = "a"\ndh = {}',
        r'does not say which: add convention = "standard"',
    ),
    "unknown convention": (
        'name = "r"\nconvention = "craig"\n[[links]]\nname = "a"\ndh = {}',
        r"convention: .*'standard' or 'modified', got 'craig'",
    ),
    "unknown kind": (
        link('dh = {}\nkind = "helical"'),
        r"links\[1\] 'a'\.kind: .*'prismatic', got 'helical'",
    ),
    "mass alone": (link("dh = {}\nmass = 1"), r"give com or first_moment with mass"),
    "mass and com alone": (
        link("dh = {}\nmass = 1\ncom = [0, 0, 0]"),
        r"give inertia_about_com or inertia_about_origin with mass",
    ),
    "com without mass": (link("dh = {}\ncom = [0, 0, 0]"), r"com is given without mass"),
    "half a tensor": (
        link("dh = {}\nmass = 1\ncom = [0,0,0]\ninertia_about_com = { Ixx = 1, Iyy = 1 }"),
        r"inertia_about_com\.Izz: is missing",
    ),
    "two com": (link("dh = {}\nmass = 1\ncom = [0, 0]"), r"links\[1\] 'a'\.com"),
    "crossed limits": (
        link("dh = {}\nlimits = { lower = 2, upper = 1 }"),
        r"limits: position limits from 2.0 to 1.0 leave no position",
    ),
    "limits beyond everything": (
        link("dh = {}\nlimits = { upper = -inf }"),
        r"limits: position limits from -inf to -inf leave no position",
    ),
    "negative limit": (
        link("dh = {}\nlimits = { velocity = -1 }"),
        r"limits\.velocity: .*greater than 0, got -1",
    ),
    "truth as mass": (link("dh = {}\nmass = true\ncom = [0,0,0]"), r"mass: .*got true"),
    "truth as term": (
        link("dh = {}\ndrive = { terms = { stribeck = { Fs = true } } }"),
        r"number is expected, got true",
    ),
    "zero axis": (link("origin = {}\naxis = [0, 0, 0]"), r"axis has length zero"),
    "no rotation": (
        link("origin = { rotation = [[1,0,0],[0,1,0],[0,0,2]] }"),
        r"not a rotation matrix",
    ),
    "mirror": (link("origin = { rotation = [[1,0,0],[0,1,0],[0,0,-1]] }"), r"det R = -1"),
    "two rotations": (
        link("origin = { rpy = [0,0,0], rotation = [[1,0,0],[0,1,0],[0,0,1]] }"),
        r"give rpy or rotation, not both",
    ),
    "unknown parent": (
        link('dh = {}\nparent = "b"'),
        r"parent of link 'a' is 'b'.*known here: root",
    ),
    "mimic of itself": (
        link('dh = {}\njoint = "j"\nmimic = { joint = "j", multiplier = 2 }'),
        r"joint 'j' mimics itself",
    ),
    "unknown length": (
        link('origin = { xyz = ["L", 0, 0] }'),
        r"uses 'L', which is not among the named lengths \(none\)",
    ),
    "clash of symbols": (
        (
            'name = "r"\nconvention = "standard"\n[lengths]\na1 = 2\n[[links]]\nname = "a"\ndh = {'
            " a = 1 }"
        ),
        r"named length a1 = 2.0 is also the symbol",
    ),
    "two links of one name": (
        link("dh = {}\n[[links]]\nname = 'a'\ndh = {}"),
        r"link name 'a' is used twice",
    ),
    "frame on nothing": (
        link("dh = {}\n[[frames]]\nname = 'f'\nlink = 'z'"),
        r"link of frame 'f' is 'z'",
    ),
    "parts and mass": (
        link(
            "dh = {}\nmass = 1\ncom = [0,0,0]\ninertia_about_com = { Ixx = 1, Iyy = 1, Izz = 1"
            " }\nparts = [{ name = 'p' }]"
        ),
        r"of the link or of its parts, not both",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_name_table_field_and_cure(tmp_path, case):
    text, message = BROKEN[case]
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with pytest.raises(DescriptionError, match=message) as caught:
        read_robot_toml(path)
    assert str(path) in str(caught.value)
    assert "pydantic" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(DescriptionError, match="cannot be read"):
        read_robot_toml(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\x00")
    with pytest.raises(DescriptionError, match="cannot be read as text"):
        read_robot_toml(tmp_path / "bytes.toml")


def test_the_documented_robot_file_is_valid():
    page = Path(__file__).resolve().parents[3] / "docs" / "reference" / "robot-file.md"
    (text,) = re.findall(r"```toml\n(.*?)```", page.read_text(), re.DOTALL)
    model = robot_from_toml(text)
    assert model.joint_names == ("shoulder", "joint_2")
    assert dict(model.lengths) == {"L1": 0.4, "a1": 0.3, "b1": 0.2}
