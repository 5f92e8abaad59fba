"""Couplings of several joints in MJCF and SDF, by equations written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.description.formats.sdf import read_sdf
from asbuilt.errors import DescriptionError

BODY = """<body pos="0 0 0.2"><joint name="{0}" axis="0 1 0" ref="{1}"/>
<geom size="0.05" mass="1" pos="0.1 0 0"/>{2}</body>"""
CHAIN = BODY.format("a", "0", BODY.format("b", "0.3", BODY.format("c", "0", "")))
MJCF = """<mujoco><compiler angle="radian"/><worldbody>{0}</worldbody>
<tendon><fixed name="t"><joint joint="c" coef="2"/><joint joint="a" coef="1"/>
<joint joint="b" coef="-4"/></fixed><fixed name="u"><joint joint="a" coef="1"/></fixed></tendon>
<equality>{1}</equality>{2}</mujoco>"""


def test_a_fixed_tendon_of_constant_length_is_a_coupling() -> None:
    """`2 c + a - 4 (b - 0.3) = 0.5`, so `c = 0.25 - 0.6 - a / 2 + 2 b`."""
    robot = read_mjcf(MJCF.format(CHAIN, '<tendon tendon1="t" polycoef="0.5 0 0 0 0"/>', ""))
    assert robot.joint_names == ("a", "b")
    np.testing.assert_allclose(robot.link_shares, [[1, 0], [0, 1], [-0.5, 2]])
    np.testing.assert_allclose(robot.link_positions(np.zeros(2))[2], 0.25 - 0.6, atol=1e-12)


@pytest.mark.parametrize("by", ["joint", "jointinparent"])
def test_a_joint_with_an_actuator_does_not_follow(by: str) -> None:
    motors = f'<actuator><motor {by}="c"/><motor joint="b"/></actuator>'
    robot = read_mjcf(MJCF.format(CHAIN, '<tendon tendon1="t"/>', motors))
    assert robot.joint_names == ("b", "c")
    np.testing.assert_allclose(robot.link_shares[2], [4, -2])


@pytest.mark.parametrize(
    "equality",
    [
        '<tendon tendon1="t" polycoef="0 0 1 0 0"/>',
        '<tendon tendon1="t" active="false"/>',
    ],
)
def test_what_is_not_linear_is_left_out_with_a_note(equality: str) -> None:
    robot = read_mjcf(MJCF.format(CHAIN, equality, ""))
    assert robot.joint_names == ("a", "b", "c")
    assert any("1 equality constraints are left out" in note for note in robot.notes)


def test_a_joint_that_follows_by_a_curve_closes_a_loop() -> None:
    equality = '<joint joint1="a" joint2="b" polycoef="0 1 0.5 0 0"/>'
    robot = read_mjcf(MJCF.format(CHAIN, equality, ""))
    (loop,) = robot.loops
    assert loop.kind == "joint"
    assert robot.joint_names == ("a", "c")
    q = np.array([[0.2, 0.1]])
    b = robot.joint_map.motion(q, 0 * q, 0 * q).q[0, 1]
    from_reference = b - 0.3
    np.testing.assert_allclose(from_reference + 0.5 * from_reference**2, 0.2, atol=1e-9)


def test_one_tendon_follows_another() -> None:
    """`2 c + a - 4 b = 3 a` with all references at zero but that of b."""
    equality = '<tendon tendon1="t" tendon2="u" polycoef="0 3 0 0 0"/>'
    robot = read_mjcf(MJCF.format(CHAIN, equality, ""))
    np.testing.assert_allclose(robot.link_shares[2], [1, 2])


SDF = """<sdf version="1.11"><model name="m"><link name="l0"/><link name="l1"/><link name="l2"/>
<joint name="base" type="fixed"><parent>world</parent><child>l0</child></joint>
<joint name="j1" type="revolute"><parent>l0</parent><child>l1</child>
<axis><xyz>0 0 1</xyz></axis></joint>
<joint name="j2" type="revolute"><parent>l1</parent><child>l2</child>
<axis><xyz>0 0 1</xyz><mimic {0}><multiplier>2</multiplier><offset>0.5</offset>
<reference>0.1</reference></mimic></axis></joint>
</model></sdf>"""


def test_mimic_of_sdf_counts_from_its_reference(tmp_path: Path) -> None:
    """`follower = multiplier (leader - reference) + offset`, specification of SDFormat 1.11."""
    file = tmp_path / "m.sdf"
    file.write_text(SDF.format('joint="j1" axis="axis"'))
    robot = read_sdf(file)
    assert robot.joint_names == ("j1",)
    np.testing.assert_allclose(robot.link_positions(np.array([0.4])), [0.4, 2 * 0.3 + 0.5])


def test_mimic_of_sdf_without_a_joint_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "m.sdf"
    file.write_text(SDF.format(""))
    with pytest.raises(DescriptionError, match="<mimic> names no joint"):
        read_sdf(file)
