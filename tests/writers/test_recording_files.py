"""What lies beside a simulated recording tells how it was made, in files that asbuilt reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot, load_robot
from asbuilt.dynamics import described_drive
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot, read_recording
from asbuilt.experiment.virtual.presets import PRESETS
from asbuilt.writers import write_simulation


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "scara"])
@pytest.mark.parametrize("preset", PRESETS["mujoco"])
def test_the_log_says_what_its_torques_are_and_the_robot_is_the_one_that_moved(
    name: str, preset: str, tmp_path: Path
) -> None:
    model = bundled_robot(name)
    simulated = VirtualRobot.preset(preset, model, rng=1).record(
        random_fourier(model, 2, duration=1.0), rng=3
    )
    files = write_simulation(tmp_path / "run.csv", simulated)
    assert (
        read_recording(files["recording"], model=model).torque_source
        == simulated.recording.torque_source
    )
    moved = load_robot(str(files["robot"]))
    np.testing.assert_allclose(moved.parameters, simulated.model.parameters, rtol=0, atol=1e-15)
    np.testing.assert_allclose(moved.gravity, simulated.model.gravity)
    drive, values = described_drive(moved)
    assert drive == simulated.drive
    np.testing.assert_allclose(values, simulated.truth[len(model.parameters) :])


def test_the_robot_file_beside_a_log_survives(tmp_path: Path) -> None:
    """A robot read from arm.toml may be recorded into arm.csv."""
    arm = tmp_path / "arm.toml"
    arm.write_text("kept = true\n")
    model = bundled_robot("two-link")
    write_simulation(
        tmp_path / "arm.csv",
        VirtualRobot.typical(model, rng=1).record(random_fourier(model, 1, duration=1.0), rng=1),
    )
    assert arm.read_text() == "kept = true\n"
