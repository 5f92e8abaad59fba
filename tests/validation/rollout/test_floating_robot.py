"""Rollouts of floating robots, against motion that MuJoCo made with a free joint and one floor."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))

from asbuilt import identify, roll_out_robot
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.description.structure.parts import Contact
from asbuilt.errors import MissingExtraError, UsageError
from asbuilt.experiment import ReadingOptions, Recording, read_fitted_recordings
from asbuilt.experiment.free_base.ground import measure_ground
from asbuilt.validation import Rollout
from asbuilt.validation.rollout.position_errors import measure_rollout_errors
from legged_robots import LEGGED
from legs import PLACE_NOISE, described, recorded
from outside_robot import other_bodies

HORIZON = 0.1


@cache
def logged(robot: str, motion: str, command: bool = True) -> tuple[RobotModel, Recording]:
    """Return a robot as it is, and its log of three seconds."""
    legged, rng = LEGGED[robot], np.random.default_rng(1)
    truth = other_bodies(described(robot), rng)
    log = recorded(legged, truth, motion, 3.0, rng, command=command)
    options = ReadingOptions(torque_source="motor")
    if command:
        options = ReadingOptions(torque_source="command", kp=(legged.kp,), kd=(legged.kd,))
    _, ((recording,),) = read_fitted_recordings(described(robot), ([log],), options)
    assert isinstance(recording, Recording)
    return truth, recording


def rolled(model: RobotModel, recording: Recording) -> Rollout:
    (found,) = roll_out_robot(model, recording, (HORIZON,))
    return found


@pytest.mark.study
@pytest.mark.parametrize(
    ("robot", "motion"),
    [("solo12", "squat"), ("solo12", "step"), ("go2", "flight"), ("go2", "hop")],
)
def test_the_true_robot_moves_as_it_did(robot: str, motion: str) -> None:
    """Errors of its base are hardly above the noise of the pose; those of CAD are."""
    truth, recording = logged(robot, motion)
    found = rolled(truth, recording)
    true, cad = found.cad, rolled(described(robot), recording).cad
    assert found.no_physics is not None
    assert true is not None
    assert cad is not None
    assert true.base is not None
    assert cad.base is not None
    # The low-pass of logs with impacts ends, and droops: it takes some of the rates at the start.
    droop = 2.0 if motion == "hop" else 1.0
    assert true.base[0] < 2.0 * droop * np.sqrt(3.0) * PLACE_NOISE
    assert true.base[1] < droop * 1.2e-3
    assert true.base[1] < cad.base[1]
    assert true.rms_all < 0.1 * found.no_physics.rms_all
    assert true.rms_all < 0.8 * cad.rms_all
    assert true.base[0] < cad.base[0]


@pytest.mark.study
def test_a_humanoid_stands_on_its_soles() -> None:
    """Its stiff servos hide other bodies, but on points it would tip."""
    truth, recording = logged("g1", "squat")
    points = tuple(replace(each, flat=False, radius=0.0) for each in truth.contacts)
    soles, tipped = (
        rolled(model, recording).cad for model in (truth, replace(truth, contacts=points))
    )
    assert soles is not None
    assert soles.base is not None
    assert soles.base[0] < 2.0 * np.sqrt(3.0) * PLACE_NOISE
    assert soles.base[1] < 4e-4
    assert tipped is not None
    assert tipped.base is not None
    assert tipped.base[1] > 5.0 * soles.base[1]


@pytest.mark.study
def test_a_logged_torque_drives_a_robot_on_the_ground() -> None:
    truth, recording = logged("solo12", "squat", command=False)
    found = rolled(truth, recording)
    assert found.driven_by == "torque"
    assert found.cad is not None
    assert found.cad.base is not None
    assert found.cad.base[0] < 1e-3
    # Without the ground it falls by g t^2 / 2, 16 mm RMS.
    hovering = replace(recording, contact=0.0 * recording.contact)
    fallen = rolled(truth, hovering).cad
    assert fallen is not None
    assert fallen.base is not None
    assert fallen.base[0] > 10.0 * found.cad.base[0]


@pytest.mark.study
def test_a_robot_climbs_stairs() -> None:
    """Floors are as high as feet stand about a window, wherever the log begins."""
    truth, recording = logged("solo12", "squat")
    upstairs = np.zeros(recording.q.shape)
    upstairs[:, 2] = 0.2 * (recording.t - recording.t[0] > 1.5)
    climbed = replace(recording, q=recording.q + upstairs)
    level, stairs = (rolled(truth, each).cad for each in (recording, climbed))
    assert level is not None
    assert stairs is not None
    late = recording.t[-1] - 0.5
    heights = [
        measure_ground(truth, each, np.array([late]), HORIZON) for each in (recording, climbed)
    ]
    assert heights[0] is not None
    assert heights[1] is not None
    assert heights[1].heights - heights[0].heights == pytest.approx(0.2, abs=1e-9)
    # The window in which the log jumps is off by the jump; the median window is not.
    assert np.median(final_heights(truth, climbed)) < 2.0 * np.median(
        final_heights(truth, recording)
    )


def final_heights(model: RobotModel, recording: Recording) -> Array:
    """Return by how much the base is too high or too low at the end of windows (W,)."""
    (motion,) = rolled(model, recording).motions
    assert motion.cad is not None
    return np.abs(motion.cad - motion.windows.q)[:, -1, 2]


@pytest.mark.study
def test_a_foot_that_never_stands_has_no_floor() -> None:
    truth, recording = logged("solo12", "squat")
    assert recording.contact is not None
    lifted = replace(recording, contact=recording.contact * [0.0, 1.0, 1.0, 1.0])
    ground = measure_ground(truth, lifted, recording.t[:1], HORIZON)
    assert ground is not None
    assert ground.heights[0, 0] < -100.0
    assert ground.heights[0, 1:] == pytest.approx(0.016, abs=1e-3)
    assert ground.normals[0] == pytest.approx([0.0, 0.0, 1.0])


@pytest.mark.study
def test_a_robot_that_falls_is_refined_under_commands() -> None:
    legged, rng = LEGGED["solo12"], np.random.default_rng(2)
    cad = described("solo12")
    log = recorded(legged, other_bodies(cad, rng), "flight", 4.0, rng, command=True)
    settings = {"torque_source": "command", "kp": (legged.kp,), "kd": (legged.kd,)}
    study = identify(
        replace(cad, contacts=()), log, holdout="last:0.3", refine="rollout", **settings
    )
    assert study.refined is not None
    assert study.refined.before is not None
    assert study.refined.after is not None
    assert study.refined.after.rms_all <= study.refined.before.rms_all
    longest = study.rollouts[-1]
    assert longest.as_built is not None
    assert longest.no_physics is not None
    assert longest.as_built.rms_all < 0.3 * longest.no_physics.rms_all


def test_without_mujoco_a_rollout_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match="mujoco"):
        identify(described("solo12"), {"t": []}, rollout=(0.1,))


def test_errors_of_a_base_are_distances_and_tilts() -> None:
    model = described("solo12")
    measured = np.zeros((2, 3, model.n_joints))
    simulated = measured.copy()
    simulated[:, 1:, :3] = [0.03, 0.0, 0.04]
    simulated[:, 1:, 3:6] = [1.0, 0.02, 0.0]
    found = measure_rollout_errors(model, [np.arange(3.0)], [measured], [simulated])
    assert found.base == pytest.approx((0.05, 0.02))
    assert found.rms_all == 0.0
    assert found.unit == "mrad"
    assert found.as_dict()["base"] == {"position": pytest.approx(0.05), "tilt": pytest.approx(0.02)}
    simulated[0, 2] = np.nan
    lost = measure_rollout_errors(model, [np.arange(3.0)], [measured], [simulated])
    assert lost.as_dict()["base"] == {"position": None, "tilt": None}


def test_a_base_in_a_plane_has_no_ground() -> None:
    model = replace(described("solo12"), contacts=(Contact("FL_FOOT"),))
    q = np.zeros((4, model.n_joints))
    recording = Recording(
        t=np.arange(4.0), q=q, tau=q, joint_names=model.joint_names, contact=np.ones((4, 1))
    )
    planar = replace(model, joints=[replace(x, name=f"{x.name}_") for x in model.joints])
    assert planar.n_floating == 0
    with pytest.raises(UsageError, match="moves in a plane"):
        measure_ground(planar, recording, np.zeros(1), HORIZON)
