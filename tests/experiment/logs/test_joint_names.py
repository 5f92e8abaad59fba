"""Every column reaches the joint whose name it bears, whatever joints are called and in whatever
order they were logged.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.description.joint_matching import find_unlabelled_joints, match_joints
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, read_recording
from asbuilt.writers import write_recording

NAMES = (
    ("j1", "j2", "j3", "hand"),
    ("j1", "j2", "finger1", "finger2"),
    ("j0", "j1", "finger0", "finger1"),
    ("axis_1", "axis_2", "tool", "tool_2"),
    ("joint_1", "joint_2", "gripper_1", "gripper_2"),
    ("joint4", "joint3", "joint2", "joint1"),
    ("left_1", "left_2", "right_1", "right_2"),
    ("robot1/j1", "robot1/j2", "robot2/j1", "robot2/j2"),
    ("a", "b", "c", "d"),
    ("d1", "d2", "d3", "d4"),
    ("q1", "q2", "q3", "q4"),
    ("3", "1", "0", "2"),
    ("speed", "torso", "tau", "i"),
    ("velocity_joint", "torque_joint", "position_joint", "time_joint"),
    ("rail [mm]", "lift (z)", "Ellenbogen-Gelenk", "Schwenkachse °"),
    ("关节一", "关节二", "关节三", "关节四"),
)


def robot_with(names: tuple[str, ...]) -> RobotModel:
    scara = bundled_robot("scara")
    return replace(
        scara,
        joints=tuple(
            replace(joint, name=name) for joint, name in zip(scara.joints, names, strict=True)
        ),
    )


def columns(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return (
        np.arange(30) / 100,
        np.cumsum(rng.normal(size=(30, 4)), axis=0),
        rng.normal(size=(30, 4)),
    )


@pytest.mark.parametrize("names", NAMES, ids=lambda names: names[0])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 0, 3, 1), (3, 2, 1, 0)], ids=str)
def test_columns_reach_the_joints_whose_names_they_bear(
    tmp_path: Path, names: tuple[str, ...], order: tuple[int, ...]
) -> None:
    t, q, tau = columns(0)
    logged = Recording(
        t=t,
        q=q[:, order],
        tau=tau[:, order],
        joint_names=tuple(names[k] for k in order),
        source="log",
    )
    read = read_recording(write_recording(tmp_path / "log.csv", logged), model=robot_with(names))
    np.testing.assert_allclose(read.q, q)
    np.testing.assert_allclose(read.tau, tau)
    assert read.joint_names == names


@pytest.mark.parametrize(
    "names",
    [("j1", "j2", "j3", "hand"), ("j1", "j2", "finger1", "finger2")],
    ids=lambda names: names[-1],
)
def test_numbered_and_named_joints_of_other_spelling(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    """`pos_joint_1` is joint j1, though named columns stand among the numbered ones."""
    t, q, tau = columns(1)
    spelled = [name.replace("j", "joint_") for name in names]
    order = (3, 1, 0, 2)
    head = ["time", *(f"pos_{spelled[k]}" for k in order), *(f"torque_{spelled[k]}" for k in order)]
    path = tmp_path / "log.csv"
    np.savetxt(
        path,
        np.column_stack([t, q[:, order], tau[:, order]]),
        delimiter=",",
        header=",".join(head),
        comments="",
        fmt="%.17g",
    )
    read = read_recording(path, model=robot_with(names))
    np.testing.assert_array_equal(read.q, q)
    np.testing.assert_array_equal(read.tau, tau)


def test_counting_from_zero_among_names_is_not_guessed(tmp_path: Path) -> None:
    t, q, tau = columns(2)
    head = [
        "time",
        *(f"{letter}_{name}" for letter in ("q", "tau") for name in ("0", "1", "2", "hand")),
    ]
    path = tmp_path / "log.csv"
    np.savetxt(
        path, np.column_stack([t, q, tau]), delimiter=",", header=",".join(head), comments=""
    )
    with pytest.raises(
        RecordingError, match=r"choose the robot that was recorded.*in a recording sheet"
    ):
        read_recording(path, model=robot_with(("j1", "j2", "j3", "hand")))


@pytest.mark.parametrize(
    ("position", "command"),
    [
        ("/controller_state/actual/positions[{}]", "/controller_state/desired/positions[{}]"),
        ("feedback.positions[{}]", "reference.positions[{}]"),
        ("/joint_states/position[{}]", "/joint_commands/position[{}]"),
        ("/joint_states/j{}/position", "/joint_commands/j{}/position"),
        ("observation.state.j{}.pos", "action.j{}.pos"),
        ("j{}/position", "j{}/reference"),
        ("Present_Position_{}", "Goal_Position_{}"),
        ("k{}_pos", "k{}_cmd"),
        ("q{}", "setpoint_{}"),
    ],
)
def test_usual_names_of_commands(tmp_path: Path, position: str, command: str) -> None:
    t = np.arange(20) * 0.01
    columns = {"t": t} | {position.format(k): t + k for k in range(3)}
    columns |= {command.format(k): t - k for k in (2, 0, 1)}
    rows = np.column_stack([*columns.values()])
    path = tmp_path / "run_qd.csv"
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
    recording = read_recording(path)
    np.testing.assert_allclose(recording.q, t[:, None] + np.arange(3))
    np.testing.assert_allclose(recording.command, t[:, None] - np.arange(3))


@pytest.mark.parametrize("name", ["action_{}", "u{}", "setpoint_temperature_{}", "goal_{}_id"])
def test_names_that_may_be_no_position_are_no_command(tmp_path: Path, name: str) -> None:
    columns = ["t", "q0", "q1", name.format(0), name.format(1)]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.ones((9, 5)), delimiter=",", header=",".join(columns), comments="")
    with pytest.raises(RecordingError, match="no columns for joint torques"):
        read_recording(path)


def test_a_number_is_no_name_of_a_joint_with_another() -> None:
    """The log of one arm is not that of another whose joints count, though three wrists count."""
    arm, counted = bundled_robot("ur10e"), bundled_robot("puma-560")
    for labels, robot in ((arm.joint_names, counted), (counted.joint_names[:3], arm)):
        with pytest.raises(RecordingError) as caught:
            match_joints(labels, robot.joint_names, source="log", robot=robot.name)
        assert caught.value.fields["missing"] is None
    with_hand = [f"lbr_{name}" for name in counted.joint_names] + ["left_finger"]
    order, (note,) = match_joints(with_hand, counted.joint_names, source="log", robot="arm")
    assert order == list(range(6))
    assert "left_finger" in note


def test_a_name_of_generic_words_alone_is_a_name() -> None:
    joints = ["shoulder", "axis"]
    assert find_unlabelled_joints(["axis", "shoulder"], joints) is None
    assert match_joints(["arm/axis", "shoulder"], joints, source="log", robot="arm")[0] == [1, 0]
