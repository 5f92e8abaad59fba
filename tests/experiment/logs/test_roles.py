"""Names of columns as loggers write them."""

from __future__ import annotations

import math

import pytest

from asbuilt.description.joint_matching import match_joints
from asbuilt.errors import RecordingError
from asbuilt.experiment import parse_unit_scale
from asbuilt.experiment.logs.columns.roles import parse_file_quantity, recognise


@pytest.mark.parametrize(
    ("name", "quantity", "joint", "index"),
    [
        ("q_0", "position", "", 0),
        ("Q7", "position", "", 7),
        ("position_1", "position", "", 1),
        ("position[3]", "position", "", 3),
        ("joint_position_2", "position", "", 2),
        ("actual_q_3", "position", "", 3),
        ("/joint_states/position[0]", "position", "", 0),
        ("/joint_states/shoulder_pan_joint/position", "position", "shoulder_pan_joint", None),
        ("lbr_A1_pos", "position", "lbr_A1", 1),
        ("q1_pos", "position", "q1", 1),
        ("θ2", "position", "", 2),
        ("qd_1", "velocity", "", 1),
        ("dq1", "velocity", "", 1),
        ("q_dot_3", "velocity", "", 3),
        ("qDot4", "velocity", "", 4),
        ("Vel.J1", "velocity", "", 1),
        ("lwr_0_joint_vel", "velocity", "lwr_0_joint", 0),
        ("ddq3", "acceleration", "", 3),
        ("qddot_1", "acceleration", "", 1),
        ("tau1", "torque", "", 1),
        ("tau_J_2", "torque", "", 2),
        ("effort", "torque", "", None),
        ("joint_1_torque", "torque", "joint_1", 1),
        ("jointTorque5", "torque", "", 5),
        ("actual_current_2", "current", "", 2),
        ("__time", "time", "", None),
        ("timestamp", "time", "", None),
    ],
)
def test_usual_names(name: str, quantity: str, joint: str, index: int | None) -> None:
    role = recognise(name)
    assert role is not None
    assert (role.quantity, role.joint, role.index) == (quantity, joint, index)


@pytest.mark.parametrize(
    "name",
    [
        "target_q_1",
        "q_d_1",
        "joint_3_temperature",
        "J1",
        "tcp_position_x",
        "comment",
        "q_cmd_2",
        "position_error_1",
    ],
)
def test_other_columns_are_left_alone(name: str) -> None:
    assert recognise(name) is None


@pytest.mark.parametrize(
    ("name", "scale"),
    [
        ("q1 [deg]", math.pi / 180),
        ("pos_deg_1", math.pi / 180),
        ("velocity_rad_s_1", 1),
        ("torque_mNm_3", 1e-3),
        ("time (ms)", 1e-3),
        ("t_us", 1e-6),
    ],
)
def test_units_in_names(name: str, scale: float) -> None:
    role = recognise(name)
    assert role is not None
    assert role.scale == pytest.approx(scale)


def test_letters_that_only_look_like_a_unit_are_none() -> None:
    role = recognise("q_1_\u017f")  # a long s, which is no s of seconds
    assert role is not None
    assert role.scale == 1.0


def test_kinds_of_torque() -> None:
    kinds = [
        role.kind
        for role in map(recognise, ("tau_1", "tau_ext_1", "motor_torque_1", "torque_sensor_1"))
        if role is not None
    ]
    assert kinds == ["", "external", "motor", "sensor"]


def test_units() -> None:
    assert parse_unit_scale("deg/s^2") == pytest.approx(math.pi / 180)
    assert parse_unit_scale("kN m") == 1000
    assert parse_unit_scale("parsec") is None


def test_quantity_of_file_names() -> None:
    assert parse_file_quantity("joint_states_efforts") == ("torque", "joint_states")
    assert parse_file_quantity("velocities_run2") == ("velocity", "run_2")
    assert parse_file_quantity("measurements")[0] is None


def matched(labels: list[str], names: list[str]) -> list[str]:
    order, _ = match_joints(labels, names, source="log", robot="arm")
    return [labels[k] for k in order]


def test_names_decide_whatever_their_order() -> None:
    assert matched(["c", "a", "b"], ["a", "b", "c"]) == ["a", "b", "c"]
    assert matched(["Wrist-1", "elbow"], ["elbow_joint", "wrist_1_joint"]) == ["elbow", "Wrist-1"]
    assert matched(["left/elbow", "left/wrist"], ["wrist", "elbow"]) == ["left/wrist", "left/elbow"]
    assert matched(["joint_2", "joint_1"], ["lbr_A1", "lbr_A2"]) == ["joint_1", "joint_2"]


def test_joints_of_a_gripper_are_left_out_and_said() -> None:
    order, notes = match_joints(["finger", "a", "b"], ["b", "a"], source="log", robot="arm")
    assert order == [2, 1]
    assert "finger" in notes[0]


def test_a_log_of_more_numbered_joints_is_of_another_robot() -> None:
    for names in (["joint_1", "joint_2"], ["A1", "A2"]):
        with pytest.raises(RecordingError, match="log has 3 joints but arm has 2"):
            match_joints(["joint_1", "joint_2", "joint_3"], names, source="log", robot="arm")


def test_other_names_are_matched_by_number_and_said() -> None:
    labels = ["lbr_joint_1", "lbr_joint_2", "lbr_joint_0"]
    order, notes = match_joints(labels, ["lbr_A1", "lbr_A2", "lbr_A3"], source="log", robot="med7")
    assert [labels[k] for k in order] == ["lbr_joint_0", "lbr_joint_1", "lbr_joint_2"]
    assert "lbr_joint_0 -> lbr_A1" in notes[0]
    assert matched(["joint_0", "joint_2", "joint_1"], ["joint_1", "joint_2", "joint_3"]) == [
        "joint_0",
        "joint_1",
        "joint_2",
    ]


@pytest.mark.parametrize(
    "labels", [["x", "y"], ["shoulder", "elbow", "wrist"], ["joint_1", "joint_3"]]
)
def test_names_that_fit_nothing_are_refused_with_both_lists(labels: list[str]) -> None:
    with pytest.raises(RecordingError, match=r"Joints of the log: .*Joints of arm: base, tip"):
        match_joints(labels, ["base", "tip"], source="log", robot="arm")
