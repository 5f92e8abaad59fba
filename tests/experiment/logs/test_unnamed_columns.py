"""Drafts of recording sheets: any order of groups is found by the robot's own torques."""

from __future__ import annotations

import tomllib
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description.catalogue import bundled_robot
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import RecordingError
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.logs.readers import read_recording

MODEL = bundled_robot("ur10e")
NAMES = {"position": "q", "velocity": "v", "torque": "f"}


@pytest.fixture(scope="module")
def values() -> dict[str, np.ndarray]:
    motion = random_fourier(MODEL, 2, duration=20.0).sample(50.0)
    tau = inverse_dynamics(MODEL, motion.q, motion.qd, motion.qdd)
    friction = 5.0 * np.sign(motion.qd)
    return {"position": motion.q, "velocity": motion.qd, "torque": 0.1 * (tau + friction)}


@pytest.mark.parametrize("order", [*permutations(NAMES), ("torque", "position")])
@pytest.mark.parametrize("header", [False, True])
def test_groups_in_any_order(
    tmp_path: Path, values: dict[str, np.ndarray], order: tuple[str, ...], header: bool
) -> None:
    table = np.column_stack([values[each] for each in order])
    names = ",".join(f"{NAMES[each]}x{k}" for each in order for k in range(6)) if header else ""
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=names, comments="")
    with pytest.raises(RecordingError) as caught:
        read_recording(tmp_path / "log.csv", model=MODEL, rate=50.0)
    text = [part for part in str(caught.value).split("\n\n") if "[columns]" in part][-1]
    sheet = tomllib.loads(text)
    assert sheet["rate"] == 50.0
    assert sheet.get("header", True) == header
    for k, each in enumerate(order):
        assert sheet["columns"][each] == f"{6 * k + 1}-{6 * k + 6}"
