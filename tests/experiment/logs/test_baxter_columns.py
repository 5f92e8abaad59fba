"""Columns of a Baxter arm, whose joints are s0 to w2, and its clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.experiment import prepare_samples, read_recording
from asbuilt.experiment.logs.columns.roles import recognise
from asbuilt.workflow import identify


@pytest.mark.parametrize(
    ("name", "quantity", "joint"),
    [
        ("ang_left_s0", "position", "left_s0"),
        ("vel_left_s1", "velocity", "left_s1"),
        ("torq_left_w2", "torque", "left_w2"),
        ("time_s", "time", ""),
    ],
)
def test_a_joint_called_s_is_no_unit_of_time(name: str, quantity: str, joint: str) -> None:
    role = recognise(name)
    assert role is not None
    assert (role.quantity, role.joint) == (quantity, joint)


def test_logged_velocities_bound_the_error_of_the_clock() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    q = np.column_stack([np.sin(t), np.cos(1.3 * t)])
    qd = np.column_stack([np.cos(t), -1.3 * np.sin(1.3 * t)])
    columns = {"t": t, "q": q, "qd": qd, "tau": q}
    right = read_recording(columns)
    assert prepare_samples(right).clock_bound < 0.03
    wrong = replace(right, t=1.1 * right.t)
    assert 0.1 < prepare_samples(wrong).clock_bound < 0.15
    assert prepare_samples(replace(right, qd=None)).clock_bound == np.inf


@pytest.mark.study
def test_the_clock_of_a_baxter_is_not_wrong(shared: Path) -> None:
    model = load_robot(str(shared / "models/baxter/baxter_left.urdf"))
    log = read_recording(shared / "data/baxter/Training_Random.csv", model=model, rate=100.0)
    assert log.qd is not None
    assert log.joint_names == model.joint_names
    codes = [each.code for each in identify(model, log).findings]
    assert "clock_wrong" not in codes
