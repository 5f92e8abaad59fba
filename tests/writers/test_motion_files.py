from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import FourierMotion, read_motion
from asbuilt.writers import write_motion

NAMES = ("shoulder", "elbow", "joint 3")


def motion() -> FourierMotion:
    return FourierMotion(np.random.default_rng(2).normal(size=(9, 3)), 5.0)


def test_round_trip_is_exact(tmp_path: Path) -> None:
    path = write_motion(tmp_path / "deep" / "motion.csv", motion(), NAMES, rate=200)
    trajectory = motion().sample(200)
    back = read_motion(path)
    assert back.joint_names == NAMES
    assert back.duration == trajectory.t[-1]
    for mine, theirs in zip(
        back.at(trajectory.t), (trajectory.q, trajectory.qd, trajectory.qdd), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(
        np.genfromtxt(path, delimiter=",", skip_header=1)[:, 1:4], trajectory.q
    )
    assert (
        path.read_text().splitlines()[0]
        == "t,q_shoulder,q_elbow,q_joint 3,qd_shoulder,qd_elbow,qd_joint"
        " 3,qdd_shoulder,qdd_elbow,qdd_joint 3"
    )
    again = write_motion(tmp_path / "again.csv", trajectory, NAMES)
    assert again.read_bytes() == path.read_bytes()
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["motion.csv"]


def test_names_must_fit_and_the_place_must_be_writable(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="3 joints needs as many different names, got a, a, b"):
        write_motion(tmp_path / "m.csv", motion(), ("a", "a", "b"))
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(UsageError, match="cannot write"):
        write_motion(blocked / "m.csv", motion(), NAMES)


@pytest.mark.parametrize("rate", [100.0, 33.0, 7.3])
def test_the_end_is_in_the_file_whatever_the_rate(tmp_path: Path, rate: float) -> None:
    whole = motion()
    back = read_motion(write_motion(tmp_path / "motion.csv", whole, NAMES, rate=rate))
    assert back.duration == pytest.approx(whole.duration, abs=1e-12)
    np.testing.assert_allclose(back.end, whole.end, atol=1e-12)
    np.testing.assert_allclose(back.derivative(back.duration, 1), 0.0, atol=1e-10)
