"""Loops in descriptions: formats, assembly modes, and what is wrong with a file."""

from __future__ import annotations

import re

import numpy as np
import pytest

from asbuilt.description import RobotModel, bundled_robot, model_document, model_from_document
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.description.formats.sdf import read_sdf
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.dynamics import inverse_dynamics
from asbuilt.dynamics.kinematics import draw_postures
from asbuilt.errors import DescriptionError, MotionError
from asbuilt.writers.models.robot_toml import format_robot_toml
from closed_chains import NAMES, TEXTS, robot_with_loops

BAR = format_robot_toml(bundled_robot("four-bar"))


def torques(model: RobotModel, like: RobotModel):
    q = draw_postures(like, np.random.default_rng(1), 10)
    q = np.vstack([q, np.tile(q[:1], (1, 1))])
    return inverse_dynamics(model, q, 2.0 * np.cos(q), 3.0 * np.sin(q))


@pytest.mark.parametrize("name", NAMES)
def test_formats_keep_loops(name: str) -> None:
    model = robot_with_loops(name)
    expected = torques(model, model)
    ways = [robot_from_toml(format_robot_toml(model)), model_from_document(model_document(model))]
    if name not in ("delta", "ankle"):
        ways.append(read_mjcf(format_mjcf(model)))
    for read in ways:
        assert read.joint_names == model.joint_names
        np.testing.assert_allclose(
            torques(read, model), expected, atol=1e-9 * np.abs(expected).max()
        )


@pytest.mark.parametrize("name", ["delta", "ankle"])
def test_mjcf_keeps_loops_of_links_without_mass(name: str) -> None:
    model = robot_with_loops(name)
    read = read_mjcf(format_mjcf(model))
    assert read.joint_names == model.joint_names
    expected = torques(model, model)
    np.testing.assert_allclose(torques(read, model), expected, atol=1e-8)


def test_passive_joints_are_found_where_the_file_does_not_name_them() -> None:
    text = re.sub(r"passive = .*\n", "", BAR)
    model = robot_from_toml(text)
    assert model.joint_names == ("crank_joint",)
    assert any("taken for passive" in note for note in model.notes)
    lever = robot_from_toml(re.sub(r"passive = .*\n", "", TEXTS["piston"]()))
    assert lever.joint_names == ("piston_joint",)
    robot = robot_from_toml(re.sub(r"passive = .*\n", "", TEXTS["palletizer"]()))
    assert robot.joint_names == ("column_joint", "lower_joint", "lever_joint")


def test_the_assembly_mode_is_that_of_the_posture() -> None:
    up = bundled_robot("four-bar")
    text = re.sub(r"posture = .*", "posture = { crank_joint = 1.0, coupler_joint = -2.4,"
                  " rocker_joint = -1.6 }", BAR)  # fmt: skip
    down = robot_from_toml(text)
    q = np.linspace(1.0, 1.0 + 4 * np.pi, 400)[:, None]
    rockers = [model.link_positions(q)[:, 2] for model in (up, down)]
    assert np.sin(rockers[0]).min() > 0.0 > np.sin(rockers[1]).max()
    # two turns of the crank bring all joints back, the coupler less two turns
    for rocker in rockers:
        np.testing.assert_allclose(rocker[0], rocker[-1], atol=1e-10)


def test_angles_follow_the_cosine_rule() -> None:
    """Freudenstein's equation of a four-bar with sides 0.5 (ground), 0.15, 0.45, 0.35."""
    model = bundled_robot("four-bar")
    q = np.linspace(0.0, 6.0, 50)
    at = model.link_positions(q[:, None])
    crank, rocker = at[:, 0], at[:, 2]
    g, a, b, c = 0.5, 0.15, 0.45, 0.35
    k1, k2, k3 = g / a, g / c, (a**2 - b**2 + c**2 + g**2) / (2 * a * c)
    np.testing.assert_allclose(
        k1 * np.cos(rocker) - k2 * np.cos(crank) + k3, np.cos(crank - rocker), atol=1e-12
    )


def test_postures_out_of_reach_are_named() -> None:
    text = BAR.replace("xyz = [0.15, 0.0, 0.0]", "xyz = [0.32, 0.0, 0.0]")
    model = robot_from_toml(text)  # not Grashof: the crank cannot turn
    with pytest.raises(MotionError, match=r"crank_joint = 3\.14\d* \(sample 1, and 1 more\)"):
        model.link_positions(np.array([[1.0], [np.pi], [3.0]]))
    at = model.closure.postures(np.array([[1.0], [np.pi]]))
    assert at.closed.tolist() == [True, False]
    assert at.distance[0] > 0.1


def broken(old: str, new: str, text: str = BAR) -> str:
    assert old in text
    return text.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (broken("point_a = [0.45,", "point_a = [0.05,"), r"a gap of 3\d\.\d mm"),
        (broken("point_a = [0.45, 0.0, 0.0]", "point_a = [0.45, 0.0, 0.01]"), r"a gap of 10 mm"),
        (broken('link_a = "coupler"', 'link_a = "coupling"'), "'coupling', which does not exist"),
        (broken('link_a = "coupler"', 'link_a = "rocker"'), "both points are on 'rocker'"),
        (
            broken('passive = ["coupler_joint", "rocker_joint"]', 'passive = ["rocker_joint"]'),
            "do not let crank_joint and coupler_joint move: more motors",
        ),
        (
            broken("[[loops]]", '[[links]]\nname = "hand"\njoint = "hand_joint"\nparent ='
                   ' "rocker"\norigin = {}\nmass = 1.0\ncom = [0,0,0]\ninertia_about_com = {Ixx ='
                   " 1.0, Iyy = 1.0, Izz = 1.0}\n\n[[loops]]").replace(
                '"rocker_joint"]', '"rocker_joint", "hand_joint"]'),
            r"leave passive joints free \(hand_joint\)",
        ),
        (broken('kind = "connect"', 'kind = "glue"'), "'connect', 'weld' or 'joint'"),
        (broken("posture = { ", "posture = { elbow = 1.0, ") if "posture = { " in BAR
         else broken("posture = {", "posture = {elbow = 1.0, "), "names joint 'elbow'"),
        (broken('passive = ["coupler_joint", "rocker_joint"]', 'passive = ["elbow"]'),
         "passive names joint 'elbow'"),
        (re.sub(r"\[\[loops\]\][^\[]*(\[[^\[]*)*?(?=\[\[|$)", "", BAR, count=1)
         if False else BAR[: BAR.index("[[loops]]")] + BAR[BAR.index("[[frames]]"):],
         "is passive, but no loop places it"),
        (broken('kind = "connect"', 'kind = "connect"\nrpy = [0, 0, 1]'), "takes no rpy"),
    ],
)  # fmt: skip
def test_bad_loops_are_named(text: str, message: str) -> None:
    with pytest.raises(DescriptionError, match=message):
        robot_from_toml(text)


def test_redundant_loops_are_closed_like_one() -> None:
    at = BAR.index("[[loops]]")
    end = BAR.index("[[frames]]")
    twice = robot_from_toml(
        BAR[:end] + BAR[at:end].replace("coupler on rocker", "again") + BAR[end:]
    )
    once = bundled_robot("four-bar")
    np.testing.assert_allclose(torques(twice, once), torques(once, once), rtol=1e-10)


def test_a_hinge_may_be_two_points_on_its_axis_and_a_weld_a_whole_link() -> None:
    end = BAR.index("[[frames]]")
    axis = "\n".join(
        f'[[loops]]\nlink_a = "coupler"\npoint_a = [0.45, 0, {z}]\nlink_b = "rocker"\n'
        f"point_b = [0.35, 0, {z}]\n"
        for z in (0.0, 0.1)
    )
    once = bundled_robot("four-bar")
    hinged = robot_from_toml(BAR[: BAR.index("[[loops]]")] + axis + BAR[end:])
    np.testing.assert_allclose(torques(hinged, once), torques(once, once), rtol=1e-9)
    pin = (
        '[[links]]\nname = "pin"\njoint = "pin_joint"\nkind = "continuous"\nparent = "coupler"\n'
        'origin = { xyz = [0.45, 0, 0] }\nnegligible = true\n\n[[loops]]\nkind = "weld"\n'
        'link_a = "pin"\nlink_b = "rocker"\npoint_b = [0.35, 0, 0]\n\n'
    )
    text = BAR[: BAR.index("[[loops]]")] + pin + BAR[end:]
    welded = robot_from_toml(text.replace('"rocker_joint"]', '"rocker_joint", "pin_joint"]'))
    np.testing.assert_allclose(torques(welded, once), torques(once, once), rtol=1e-9)
    assert read_mjcf(format_mjcf(welded)).joint_names == ("crank_joint",)
    np.testing.assert_allclose(
        torques(read_mjcf(format_mjcf(welded)), once), torques(once, once), rtol=1e-6
    )


def test_a_joint_follows_a_polynomial_of_another() -> None:
    text = BAR[: BAR.index("[[loops]]")] + (
        '[[loops]]\nkind = "joint"\njoints = ["rocker_joint", "crank_joint"]\n'
        'polynomial = [1.5, 0.2, -0.1]\n\n[[loops]]\nkind = "joint"\njoints = ["coupler_joint"]\n'
        "polynomial = [0.7]\n\n"
    ) + BAR[BAR.index("[[frames]]") :]  # fmt: skip
    model = robot_from_toml(text)
    q, qd = np.array([[0.3], [1.2]]), np.array([[2.0], [-1.0]])
    moved = model.link_motion(q, qd, 0.5 * qd)
    slope = 0.2 - 0.2 * q[:, 0]
    np.testing.assert_allclose(moved.q[:, 2], 1.5 + 0.2 * q[:, 0] - 0.1 * q[:, 0] ** 2)
    np.testing.assert_allclose(moved.qd[:, 2], slope * qd[:, 0])
    expected = slope * 0.5 * qd[:, 0] - 0.2 * qd[:, 0] ** 2
    np.testing.assert_allclose(moved.qdd[:, 2], expected)
    np.testing.assert_allclose(moved.q[:, 1], 0.7)
    np.testing.assert_allclose(torques(read_mjcf(format_mjcf(model)), model), torques(model, model))


def test_a_file_extends_another_by_a_loop(tmp_path) -> None:
    from asbuilt.description import load_robot

    whole = bundled_robot("four-bar")
    tree = BAR[: BAR.index("[[loops]]")] + BAR[BAR.index("[[frames]]") :]
    tree = re.sub(r"(passive|posture) = .*\n", "", tree)
    (tmp_path / "tree.toml").write_text(tree)
    head = [line for line in BAR.splitlines() if line.startswith(("passive", "posture"))]
    loop = BAR[BAR.index("[[loops]]") : BAR.index("[[frames]]")]
    (tmp_path / "robot.toml").write_text('extends = "tree.toml"\n' + "\n".join(head) + "\n" + loop)
    np.testing.assert_allclose(
        torques(load_robot(tmp_path / "robot.toml"), whole), torques(whole, whole), rtol=1e-12
    )


def sdf_bar(last: str) -> str:
    """The four-bar with the crank along x: a parallelogram of sides 0.5 and 0.2."""

    def link(name: str, x: float, z: float, mass: float) -> str:
        return (
            f'<link name="{name}"><pose>{x} 0 {z} 0 0 0</pose><inertial><pose>0.1 0 0 0 0 0</pose>'
            f"<mass>{mass}</mass><inertia><ixx>0.01</ixx><iyy>0.02</iyy><izz>0.02</izz></inertia>"
            "</inertial></link>"
        )

    def joint(name: str, parent: str, child: str, pose: str = "", limit: str = "") -> str:
        return (
            f'<joint name="{name}" type="revolute">{pose}<parent>{parent}</parent>'
            f"<child>{child}</child><axis><xyz>0 1 0</xyz>{limit}</axis></joint>"
        )

    effort = "<limit><effort>20</effort></limit>"
    return (
        '<sdf version="1.9"><model name="bar">'
        + link("crank", 0, 0, 1.0) + link("coupler", 0, 0.2, 2.0) + link("rocker", 0.45, 0, 1.5)
        + joint("a", "world", "crank", limit=effort)
        + joint("b", "crank", "coupler") + joint("c", "world", "rocker") + last
        + "</model></sdf>"
    )  # fmt: skip


def test_sdf_closes_a_loop_by_a_joint_to_a_link_that_another_one_moves() -> None:
    hinge = (
        '<joint name="d" type="{}"><pose>-0.05 0 0.3 0 0 0</pose><parent>coupler</parent>'
        "<child>rocker</child><axis><xyz>0 1 0</xyz></axis></joint>"
    )
    robots = [read_sdf(sdf_bar(hinge.format(kind))) for kind in ("revolute", "ball")]
    for robot in robots:
        assert robot.joint_names == ("a",)
        assert all(joint.is_passive for joint in robot.followers)
    np.testing.assert_allclose(
        torques(robots[0], robots[0]), torques(robots[1], robots[0]), rtol=1e-9
    )
    with pytest.raises(DescriptionError, match="not 'prismatic'"):
        read_sdf(sdf_bar(hinge.format("prismatic")))
