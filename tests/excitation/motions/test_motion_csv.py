from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import Joint, Link, LinkInertia, RobotModel
from asbuilt.errors import MotionError
from asbuilt.excitation import FourierMotion, read_motion
from asbuilt.writers import write_motion

NAMES = ("shoulder", "elbow", "joint 3")


def motion() -> FourierMotion:
    return FourierMotion(np.random.default_rng(2).normal(size=(9, 3)), 5.0)


def robot(names: tuple[str, ...]) -> RobotModel:
    joints = tuple(
        Joint(name, "revolute", i - 1, np.eye(4), np.eye(4)) for i, name in enumerate(names)
    )
    return RobotModel(
        "three", joints, tuple(Link(f"link {name}", LinkInertia.zero()) for name in names)
    )


def test_between_the_samples_the_motion_is_interpolated_smoothly(tmp_path: Path) -> None:
    back = read_motion(write_motion(tmp_path / "m.csv", motion(), NAMES, rate=50))
    t = np.linspace(0, back.duration, 1777)
    for mine, theirs, tolerance in zip(back.at(t), motion().at(t), (1e-7, 1e-5, 5e-3), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=tolerance * np.abs(theirs).max())


def test_joints_are_matched_by_name(tmp_path: Path) -> None:
    path = write_motion(tmp_path / "m.csv", motion(), NAMES, rate=50)
    back = read_motion(path, robot(("joint 3", "shoulder", "elbow")))
    np.testing.assert_allclose(
        back.derivative(1.0), motion().derivative(1.0)[[2, 0, 1]], atol=1e-12
    )
    with pytest.raises(
        MotionError,
        match=r"missing joints wrist, unknown joints elbow; the robot has shoulder, wrist, joint 3",
    ):
        read_motion(path, robot(("shoulder", "wrist", "joint 3")))


def test_positions_alone_are_enough(tmp_path: Path) -> None:
    path = tmp_path / "positions.csv"
    t = np.arange(0, 5.0001, 0.01)
    table = np.column_stack([t + 100.0, motion().derivative(t)])
    np.savetxt(path, table, delimiter=",", header="t,q_a,q_b,q_c", comments="", fmt="%.17g")
    back = read_motion(path)
    middle = t[50:-50]
    np.testing.assert_allclose(
        back.derivative(middle, 1), motion().derivative(middle, 1), atol=1e-6
    )
    np.testing.assert_allclose(
        back.derivative(middle, 2), motion().derivative(middle, 2), atol=1e-3
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read"),
        ("t,q_a\n", "a header but no data"),
        (
            "time,x\n0,1\n1,2\n",
            "not a motion: it needs a column t and columns q_<joint>; it has time, x",
        ),
        (
            "t,q_a,qd_a,qdd_a\n0,1,0,0\n0,2,0,0\n",
            "rise from line to line and there must be two; they do not at line 3",
        ),
        ("t,q_a,qd_a,qdd_a\n0,1,0,0\n", "must be two"),
        (
            "t,q_a,qd_a,qdd_a\n0,1,0,0\n1,oops,0,0\n",
            "line 3, column q_a holds 'oops', not a number",
        ),
        ("t,q_a,qd_a,qdd_a\n0,1,0,0\n1,,0,0\n", "line 3, column q_a is empty or not finite"),
        ("t,q_a,qd_a,qdd_a\n0,1,0,0\n1,NaN,0,0\n", "line 3, column q_a is empty or not finite"),
        ("t,q_a,q_b,qd_a,qdd_a,qdd_b\n0,1,0,0,0,0\n1,2,0,0,0,0\n", "has no column qd_b"),
        ("t,q_a\n0,1\n1,2\n", "give these or at least 6 positions"),
        ("t,q_a,qd_a,qdd_a\n0,1,0,0\n1e-9,2,0,0\n", "line 3 comes 1e-09 s after the one before"),
        ("t,q_a,qd_a,qdd_a\n0,1,0,0\n1e9,2,0,0\n", r"line 3 comes 1e\+09 s after the one before"),
        ("t,q_a,qd_a,qdd_a\n0,1,0,0\n1,1e300,0,0\n", r"line 3, column q_a is 1e\+300; it must"),
    ],
)
def test_bad_files_are_refused_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(MotionError, match=message) as caught:
        read_motion(path)
    assert "bad.csv" in str(caught.value)


def test_a_missing_file_and_a_binary_one_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="cannot be read"):
        read_motion(tmp_path / "none.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(bytes(range(256)) * 20)
    with pytest.raises(MotionError):
        read_motion(binary)


def test_numbers_name_joints_as_they_do_in_logs(tmp_path: Path) -> None:
    """Columns q_1 to q_3 are those of the robot's joints in order, whatever these are called."""
    path = write_motion(tmp_path / "m.csv", motion(), ("1", "2", "3"), rate=50)
    back = read_motion(path, robot(("shoulder", "elbow", "hand")))
    assert back.joint_names == ("shoulder", "elbow", "hand")
    np.testing.assert_allclose(back.at(0.0)[0], motion().at(0.0)[0], atol=1e-12)
    with pytest.raises(MotionError, match="missing joints a, b, c, d"):
        read_motion(path, robot(("a", "b", "c", "d")))
