"""Zero positions and clock that a recording sheet corrects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.errors import RecordingError
from asbuilt.experiment import read_recording

MODEL = bundled_robot("two-link")


def log_with(folder: Path, sheet: str) -> Path:
    rows = "\n".join(f"{0.02 * k},{0.1 * k},{-0.2 * k},1,2" for k in range(50))
    log = folder / "log.csv"
    log.write_text("t,q_1,q_2,tau_1,tau_2\n" + rows + "\n")
    (folder / "log.toml").write_text(sheet)
    return log


def test_zero_positions_are_subtracted(tmp_path: Path) -> None:
    recording = read_recording(log_with(tmp_path, "zero = [0.5, -0.25]"), model=MODEL)
    np.testing.assert_allclose(recording.q[:, 0], 0.1 * np.arange(50) - 0.5)
    np.testing.assert_allclose(recording.q[:, 1], -0.2 * np.arange(50) + 0.25)
    assert any("positions count from 0.5, -0.25" in note for note in recording.notes)


def test_positions_that_turn_the_other_way(tmp_path: Path) -> None:
    sheet = "position_sign = [1, -1]\nzero = [0.5, -0.25]"
    recording = read_recording(log_with(tmp_path, sheet), model=MODEL)
    np.testing.assert_allclose(recording.q[:, 0], 0.1 * np.arange(50) - 0.5)
    np.testing.assert_allclose(recording.q[:, 1], -(-0.2 * np.arange(50) + 0.25))
    np.testing.assert_allclose(recording.tau, np.tile([1.0, 2.0], (50, 1)))
    assert any("positions were multiplied by 1, -1" in note for note in recording.notes)


def test_the_clock_is_multiplied(tmp_path: Path) -> None:
    recording = read_recording(log_with(tmp_path, "time_factor = 0.5"), model=MODEL)
    np.testing.assert_allclose(np.diff(recording.t), 0.01)


def log_of_two_channels(folder: Path, sheet: str) -> Path:
    """Write a log whose second encoder reads 0.01 more, and whose external torque is constant."""
    names = "t,q_1,q_2,q_motor_1,q_motor_2,tau_1,tau_2,tau_ext_1,tau_ext_2"
    rows = "\n".join(
        f"{0.02 * k},{0.1 * k},{-0.2 * k},{0.1 * k + 0.01},{-0.2 * k + 0.01},1,2,3,4"
        for k in range(50)
    )
    log = folder / "log.csv"
    log.write_text(f"{names}\n{rows}\n")
    columns = (
        'position = "q_1-q_2"\nmotor_position = "q_motor_1-q_motor_2"\ntorque = "tau_1-tau_2"\n'
        'extra = { tau_ext = "tau_ext_1-tau_ext_2" }'
    )
    (folder / "log.toml").write_text(f"{sheet}\n[columns]\n{columns}\n")
    return log


def test_a_second_encoder_has_the_same_sign_and_zero_as_the_first(tmp_path: Path) -> None:
    sheet = "position_sign = [1, -1]\nzero = [0.5, -0.25]"
    recording = read_recording(log_of_two_channels(tmp_path, sheet), model=MODEL)
    ahead = recording.extra["q_motor"] - recording.q
    np.testing.assert_allclose(ahead, np.tile([0.01, -0.01], (50, 1)))


def test_a_second_encoder_has_the_unit_of_its_joint(tmp_path: Path) -> None:
    log = log_of_two_channels(tmp_path, 'joint_units = { joint_2 = "deg" }')
    recording = read_recording(log, model=MODEL)
    ahead = recording.extra["q_motor"] - recording.q
    np.testing.assert_allclose(ahead, np.tile([0.01, np.deg2rad(0.01)], (50, 1)))


def test_a_joint_may_have_another_unit_than_the_rest(tmp_path: Path) -> None:
    sheet = 'units = { position = "deg" }\njoint_units = { joint_2 = "rad" }'
    recording = read_recording(log_with(tmp_path, sheet), model=MODEL)
    np.testing.assert_allclose(recording.q[:, 0], np.deg2rad(0.1 * np.arange(50)))
    np.testing.assert_allclose(recording.q[:, 1], -0.2 * np.arange(50))


def test_signs_of_single_joints_turn_their_external_torques_too(tmp_path: Path) -> None:
    recording = read_recording(log_of_two_channels(tmp_path, "sign = [1, -1]"), model=MODEL)
    np.testing.assert_allclose(recording.tau, np.tile([1.0, -2.0], (50, 1)))
    np.testing.assert_allclose(recording.extra["tau_ext"], np.tile([3.0, -4.0], (50, 1)))


@pytest.mark.parametrize(
    ("sheet", "said"),
    [
        ("zero = [1, 2, 3]", "3 zero positions for 2 joints"),
        ("zero = [nan, 0]", "zero"),
        ("time_factor = 0", "time_factor"),
        ("position_sign = [1, 2]", "position_sign"),
        ("position_sign = [1, 1, 1]", "3 position signs for 2 joints"),
    ],
)
def test_impossible_corrections_are_refused(tmp_path: Path, sheet: str, said: str) -> None:
    with pytest.raises(RecordingError, match=said):
        read_recording(log_with(tmp_path, sheet), model=MODEL)
