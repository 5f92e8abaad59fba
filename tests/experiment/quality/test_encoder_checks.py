"""The lag between two encoders of a joint, from signals whose lag is known, and a real arm's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.experiment import check_recording, read_recording
from asbuilt.experiment.quality.position_checks import estimate_encoder_lag

KR300 = {
    "torque_source": "motor",
    "gains": [256.857143, 267.428571, 252.333333, 221.0, 239.619048, 154.323134],
    "zero": [0.0, 1.5707963267948966, -1.5707963267948966, 0.0, 0.0, 0.0],
}


def angle(t):
    return np.sin(2.0 * t) + 0.3 * np.sin(5.0 * t)


@pytest.mark.parametrize(("sign", "zero"), [(1.0, 0.0), (-1.0, 0.4)])
def test_a_known_lag_is_found_within_its_error(sign: float, zero: float) -> None:
    t = np.arange(0.0, 20.0, 0.004)
    rng = np.random.default_rng(1)
    z = [
        (found.value - 0.003) / found.std_error
        for found in (
            estimate_encoder_lag(
                t, angle(t), sign * angle(t - 0.003) + zero + 1e-4 * rng.normal(size=t.size)
            )
            for _ in range(40)
        )
        if found is not None
    ]
    assert len(z) == 40
    assert abs(np.mean(z)) < 0.8
    assert 0.6 < np.std(z) < 1.6


def test_an_encoder_that_does_not_move_has_no_lag() -> None:
    t = np.arange(0.0, 2.0, 0.01)
    assert estimate_encoder_lag(t, angle(t), np.zeros_like(t)) is None


def test_motor_and_link_columns_are_two_encoders() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    columns = {"t": t} | {
        f"{name}_{k}": value
        for k in (1, 2)
        for name, value in (
            ("q_motor", angle(t)),
            ("q_link", angle(t - 0.002)),
            ("tau_motor", np.cos(t)),
        )
    }
    read = read_recording(columns)
    assert read.torque_source == "motor"
    np.testing.assert_array_equal(read.q[:, 0], columns["q_motor_1"])
    np.testing.assert_array_equal(read.extra["q_link"][:, 1], columns["q_link_2"])
    only_motors = {name: value for name, value in columns.items() if "link" not in name}
    np.testing.assert_array_equal(read_recording(only_motors).q, read.q)


def test_a_sheet_names_the_second_encoder() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    columns = {"t": t, "a": angle(t), "b": np.rad2deg(angle(t - 0.002)), "tau": np.cos(t)}
    sheet = {
        "columns": {"position": ["a"], "link_position": ["b"], "torque": ["tau"]},
    }
    np.testing.assert_array_equal(
        read_recording(columns, sheet=sheet).extra["q_link"][:, 0], columns["b"]
    )


@pytest.mark.parametrize("log", ["A.csv", "B.csv"])
def test_the_encoders_of_a_kr300_are_three_milliseconds_apart(shared: Path, log: str) -> None:
    model = load_robot(str(shared / "models/kuka_kr300.toml"))
    read = read_recording(shared / "data/kr300" / log, model=model, sheet=KR300)
    for k in range(3):
        found = estimate_encoder_lag(read.t, read.q[:, k], read.extra["q_link"][:, k])
        assert found is not None
        assert found.value == pytest.approx(3.0e-3, abs=3.0 * found.std_error)
        assert found.explained > 0.93
    (said,) = [each for each in check_recording(model, read).findings if each.code == "encoder_lag"]
    assert "joint_3" in said.message
    assert "joint_4" in said.message
