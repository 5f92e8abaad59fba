"""Logs that have columns of joints that follow others."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment import check_recording, read_fitted_recordings
from coupled_robots import palletizer

NAMES = ("a1", "a2", "a3", "level", "a6", "f1", "f2", "f3")
OFFSETS = {"level": ("a3", -1.0, 0.1), "f2": ("f1", -1.0, 0.01), "f3": ("f1", -2.0, 0.04)}


def columns(wrong: float = 0.0, torque: float = 0.0) -> dict[str, np.ndarray]:
    t = np.arange(0.0, 4.0, 0.01)
    found = {"t": t}
    for k, name in enumerate(n for n in NAMES if n not in OFFSETS):
        found[f"q_{name}"] = 0.3 * np.sin((1.0 + 0.3 * k) * t)
        found[f"tau_{name}"] = np.cos(t)
    for name, (master, multiplier, offset) in OFFSETS.items():
        found[f"q_{name}"] = multiplier * found[f"q_{master}"] + offset
        found[f"tau_{name}"] = torque * np.ones_like(t)
    found["q_level"] = found["q_level"] + wrong * np.sin(t)
    return found


def test_columns_of_followers_are_read_beside_those_of_the_joints() -> None:
    robot = palletizer()
    model, ((recording,),) = read_fitted_recordings(robot, [[columns()]])
    assert recording.joint_names == model.joint_names == robot.joint_names
    assert not model.locked_joints
    np.testing.assert_array_equal(recording.q[:, 2], columns()["q_a3"])
    assert not {"coupling_disagrees", "follower_torque"} & set(
        check_recording(model, recording).codes
    )


def test_a_follower_logged_elsewhere_is_named() -> None:
    model, ((recording,),) = read_fitted_recordings(palletizer(), [[columns(wrong=0.2)]])
    found = [
        f for f in check_recording(model, recording).findings if f.code == "coupling_disagrees"
    ]
    assert [finding.joint for finding in found] == ["level"]
    assert "a3" in found[0].message


def test_a_torque_of_a_follower_is_named() -> None:
    model, ((recording,),) = read_fitted_recordings(palletizer(), [[columns(torque=2.0)]])
    found = [f for f in check_recording(model, recording).findings if f.code == "follower_torque"]
    assert {finding.joint for finding in found} == set(OFFSETS)


def test_the_log_needs_no_column_of_a_follower() -> None:
    some = {k: v for k, v in columns().items() if k.partition("_")[2] not in OFFSETS}
    model, ((recording,),) = read_fitted_recordings(palletizer(), [[some]])
    assert recording.n_joints == model.n_joints == 5
    assert not model.locked_joints


def test_unnamed_columns_of_all_joints_are_refused() -> None:
    t = np.arange(0.0, 2.0, 0.01)
    with pytest.raises(RecordingError, match=r"8 position columns.*has 5 joints") as caught:
        read_fitted_recordings(
            palletizer(), [[{"t": t, "q": np.ones((t.size, 8)), "tau": np.ones((t.size, 8))}]]
        )
    assert "joints that follow others have no column: level, f2, f3" in str(caught.value)


def test_a_follower_of_a_joint_that_the_log_lacks_is_locked_with_it() -> None:
    some = {k: v for k, v in columns().items() if not k.endswith(("_f1", "_f2", "_f3"))}
    model, _ = read_fitted_recordings(palletizer(), [[some]])
    assert model.locked_joints == pytest.approx({"f1": 0.0, "f2": 0.01, "f3": 0.04})
    assert [joint.name for joint in model.followers] == ["level"]
