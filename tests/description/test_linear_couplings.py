"""Couplings of motors and joints in robot files: what they say, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import RobotModel, load_robot
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.errors import DescriptionError
from asbuilt.writers.models.robot_toml import format_robot_toml

LINKS = "".join(
    f'[[links]]\nname = "l{k}"\njoint = "j{k}"\norigin = {{ xyz = [0.3, 0, 0] }}\n'
    "mass = 1.0\ncom = [0.1, 0, 0]\ninertia_about_com = { Ixx = 0.1, Iyy = 0.1, Izz = 0.1 }\n"
    for k in (1, 2, 3)
)
MOTORS = '[[motors]]\nname = "m2"\n[[motors]]\nname = "m3"\n'
WRIST = (
    "[[couplings]]\nj2 = { m2 = 1.5 }\n[[couplings]]\nj3 = { m2 = -0.8, m3 = 1.2 }\noffset = 0.1\n"
)


def robot(more: str) -> RobotModel:
    return robot_from_toml(f'name = "arm"\n{LINKS}{more}')


def test_motors_are_the_coordinates_of_the_joints_that_they_move() -> None:
    arm = robot(MOTORS + WRIST)
    assert arm.joint_names == ("j1", "m2", "m3")
    assert arm.tree.joint_names == ("j1", "j2", "j3")
    q = np.array([0.3, 0.4, 0.5])
    np.testing.assert_allclose(arm.link_positions(q), [0.3, 0.6, 0.1 - 0.32 + 0.6])
    np.testing.assert_array_equal(arm.motor_shares, [[0, 0, 0], [0, 0, 0], [0, -0.8, 1.2]])


def test_a_motor_may_have_the_name_of_its_joint_and_follow_the_order_of_links() -> None:
    arm = robot(
        '[[motors]]\nname = "j3"\n[[motors]]\nname = "j2"\n'
        "[[couplings]]\nj3 = { j2 = 1.0, j3 = 1.0 }\n[[couplings]]\nj2 = { j2 = 2.0 }\n"
    )
    assert arm.joint_names == arm.tree.joint_names == ("j1", "j2", "j3")
    np.testing.assert_array_equal(arm.link_shares, [[1, 0, 0], [0, 2, 0], [0, 1, 1]])


def test_followers_of_several_joints_and_of_followers() -> None:
    arm = robot("[[couplings]]\nj3 = { j1 = -1.0, j2 = -2.0 }\noffset = 0.5\n")
    assert arm.joint_names == ("j1", "j2")
    np.testing.assert_array_equal(arm.link_shares, [[1, 0], [0, 1], [-1, -2]])
    chain = robot(
        "[[couplings]]\nj2 = { j1 = 2.0 }\noffset = 1.0\n[[couplings]]\nj3 = { j2 = 3.0 }\n"
    )
    np.testing.assert_array_equal(chain.link_shares, [[1], [2], [6]])
    np.testing.assert_allclose(chain.link_positions(np.zeros(1)), [0, 1, 3])


@pytest.mark.parametrize("more", [MOTORS + WRIST, "[[couplings]]\nj3 = { j1 = -1.0, j2 = -2.0 }\n"])
def test_the_robot_file_holds_couplings(more: str) -> None:
    arm = robot(more)
    again = robot_from_toml(format_robot_toml(arm))
    assert again.joint_names == arm.joint_names
    assert again.link_names == arm.link_names
    np.testing.assert_array_equal(again.link_shares, arm.link_shares)
    np.testing.assert_array_equal(again.motor_shares, arm.motor_shares)


def test_a_file_extends_another_description(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text(f'name = "arm"\n{LINKS}')
    (tmp_path / "coupled.toml").write_text(
        f'extends = "base.toml"\nname = "wrist"\n{MOTORS}{WRIST}'
    )
    arm = load_robot(tmp_path / "coupled.toml")
    assert (arm.name, arm.joint_names) == ("wrist", ("j1", "m2", "m3"))
    np.testing.assert_array_equal(arm.parameters, robot("").parameters)
    np.testing.assert_array_equal(arm.link_shares, robot(MOTORS + WRIST).link_shares)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[[couplings]]\nj9 = { j1 = 1.0 }\n", "moves joint 'j9', which does not exist"),
        (
            "[[couplings]]\nj3 = { j9 = 1.0 }\n",
            "'j9', which is neither a joint nor one of the motors",
        ),
        ("[[couplings]]\nj3 = { j2 = 1.0 }\n[[couplings]]\nj2 = { j3 = 1.0 }\n", "mimics itself"),
        (
            "[[couplings]]\nj3 = { j2 = 1.0 }\n[[couplings]]\nj3 = { j1 = 1.0 }\n",
            "two couplings say",
        ),
        (MOTORS, "motor 'm2' moves no joint of its own"),
        (MOTORS + "[[couplings]]\nj3 = { m2 = 1.0, m3 = 1.0 }\n", "moves no joint of its own"),
        (
            MOTORS + "[[couplings]]\nj2 = { m2 = 1.0, m3 = 2.0 }\n[[couplings]]\n"
            "j3 = { m2 = 2.0, m3 = 4.0 }\n",
            "contradictory: some motion of m2, m3 moves no link",
        ),
        ('[[motors]]\nname = "j3"\n', "has the name of a joint that no coupling moves"),
        (MOTORS + '[[motors]]\nname = "m2"\n' + WRIST, "motor 'm2' is given twice"),
        ("[[couplings]]\nj3 = { j2 = nan }\n", "j3.j2: Input should be a finite number"),
        ("[[couplings]]\nj3 = {}\n", "finite factors"),
        ("[[couplings]]\nj3 = { j3 = 2.0 }\n", "move with itself"),
        ('[[couplings]]\nj3 = { j2 = 1.0 }\nmotor = "j2"\n', "give one joint and what moves it"),
        ('[[couplings]]\nmotor = "j2"\n', "turns is missing"),
    ],
)
def test_contradictions_are_named(more: str, message: str) -> None:
    with pytest.raises(DescriptionError, match=message):
        robot(more)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('extends = "none.urdf"\n', "where there is no file"),
        ('extends = "robot.toml"\n', "more than 8 files extend one another"),
        (f'extends = "none.urdf"\n{LINKS}', "links cannot be given again"),
    ],
)
def test_what_extends_nothing_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(DescriptionError, match=message):
        load_robot(tmp_path / "robot.toml")


def test_locking_a_motor_moves_its_part_into_the_offset() -> None:
    arm = robot(MOTORS + WRIST)
    held = arm.locked({"m3": 0.5})
    assert held.joint_names == ("j1", "m2")
    q = np.array([0.3, 0.4])
    np.testing.assert_allclose(
        held.link_positions(q), arm.link_positions(np.array([0.3, 0.4, 0.5])), atol=1e-15
    )
    both = arm.locked({"m2": 0.4, "m3": 0.5})
    assert (both.joint_names, both.n_links) == (("j1",), 1)
    assert both.locked_joints == {"m2": 0.4, "m3": 0.5}


def test_a_lock_that_nobody_gave_is_a_guess_where_it_moves_or_carries_what_moves() -> None:
    """Motor m3 turns j3 beside m2; j3 is the last joint, and carries none."""
    arm = robot(MOTORS + WRIST)
    assert arm.locked(["m3"]).assumed_carriers == ("m3",)
    assert arm.locked({"m3": 0.5}).assumed_carriers == ()
    assert arm.locked(["m2", "m3"]).assumed_carriers == ()
    assert arm.locked({"m2": None, "m3": 0.5}).assumed_carriers == ()
    assert arm.locked(["j1", "m3"]).assumed_carriers == ("j1", "m3")
