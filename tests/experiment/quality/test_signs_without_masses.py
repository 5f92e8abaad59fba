"""Signs of torques by friction, where the description has kinematics alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import RobotModel, load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording, read_recording, simulate_recording

UR10E = """
header = false
torque_source = "current"
gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]
[columns]
time = 1
position = "2-7"
velocity = "8-13"
torque = "14-19"
"""
LOGS = {
    "lwr4": ("kuka_lwr4.urdf", "kuka_lwr4/measurements_1.npz", {}),
    "med7": (
        "lbrstack_med7.urdf",
        "lbr_med7/measurements_with_ext_tau_1_dgr.csv",
        {"rate": 100.0, "flip_torque": True},
    ),
    "ur10e": ("ur10e.urdf", "ur10e/ur-20_02_10-30sec_12harm.csv", {"sheet": UR10E}),
    "airbot": ("airbot/airbot_play.urdf", "airbot/vali_opt.csv", {"sheet": "sheet.toml"}),
    "baxter": ("baxter/baxter_left.urdf", "baxter/Training_Random.csv", {"rate": 100.0}),
    "xmate": ("rokae_xmate.toml", "rokae_two_channels/rokae_a.csv", {}),
}


def kinematics_and_log(shared: Path, tmp_path: Path, name: str) -> tuple[RobotModel, Recording]:
    description, log, options = LOGS[name]
    model = load_robot(str(shared / "models" / description))
    if options.get("sheet") == UR10E:
        (tmp_path / "sheet.toml").write_text(UR10E)
        options = {"sheet": tmp_path / "sheet.toml"}
    elif "sheet" in options:
        options = {"sheet": (shared / "data" / log).parent / options["sheet"]}
    recording = read_recording(shared / "data" / log, model=model, **options)
    return model.with_parameters(np.zeros(10 * model.n_links)), recording


@pytest.mark.study
@pytest.mark.parametrize("name", LOGS)
def test_signs_of_real_logs_are_right_and_turned_ones_are_not(
    shared: Path, tmp_path: Path, name: str
) -> None:
    model, recording = kinematics_and_log(shared, tmp_path, name)
    found = check_recording(model, recording)
    assert not {"torque_flipped", "joint_torque_flipped"} & set(found.codes)
    (said,) = [each for each in found.findings if each.code == "no_inertia"]
    assert "scale of the torques" in said.message
    if "by friction at" not in said.message:
        pytest.skip("this log shows no friction")
    turned = check_recording(model, recording.flipped())
    assert {"torque_flipped", "joint_torque_flipped"} & set(turned.codes)


@pytest.mark.study
def test_a_single_turned_joint_is_named(shared: Path, tmp_path: Path) -> None:
    model, recording = kinematics_and_log(shared, tmp_path, "xmate")
    tau = np.array(recording.tau)
    tau[:, 4] *= -1.0
    found = check_recording(model, replace(recording, tau=tau))
    (said,) = [each for each in found.findings if each.code == "joint_torque_flipped"]
    assert said.joint == "joint_5"
    assert "-1" in str(said.cure)


def test_a_sign_that_was_flipped_is_flipped_back() -> None:
    robot = load_robot("two-link")
    motion = random_fourier(robot, rng=3, duration=20.0, n_harmonics=5)
    log = simulate_recording(robot, motion, rate=100.0)
    assert log.qd is not None
    kinematics = robot.with_parameters(np.zeros(10 * robot.n_links))
    braked = replace(log, tau=np.sign(log.qd) + 0.2 * log.qd)
    for turned, said in (
        (replace(braked, tau=-braked.tau), "flip the torque sign, or"),
        (braked.flipped(), "flip the torque sign back"),
    ):
        found = check_recording(kinematics, turned)
        (flipped,) = [f for f in found.findings if f.code == "torque_flipped"]
        assert said in str(flipped.cure)
    stated = check_recording(kinematics, replace(braked.flipped(), stated=frozenset({"sign"})))
    (flipped,) = [f for f in stated.findings if f.code == "torque_flipped"]
    assert flipped.severity == "warning"
