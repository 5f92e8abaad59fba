"""Studies of robots with closed chains, on motion that MuJoCo made with equality constraints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt import simulate_recording
from asbuilt.description import bundled_robot
from asbuilt.dynamics import link_poses
from asbuilt.errors import DescriptionError, MotionError, RecordingError
from asbuilt.excitation import (
    DesignOptions,
    check_motion,
    design_motion,
    random_fourier,
    random_point_to_point,
)
from asbuilt.experiment import VirtualRobot, check_recording
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.workflow import StudyOptions, identify
from asbuilt.writers.models.c.c_dynamics import Mechanism
from asbuilt.writers.models.urdf import format_urdf
from closed_chains import NAMES, robot_with_loops

pytest.importorskip("mujoco")
OPTIONS = StudyOptions(method="wls", drive="viscous,coulomb,offset")


def errors_in_sigmas(name: str, seed: int):
    """Estimates less the truth in standard errors."""
    model = robot_with_loops(name)
    robot = VirtualRobot.preset("lab", model, rng=seed)
    motion = random_fourier(model, rng=seed, duration=16.0)
    logged = robot.record(motion, rng=seed, rate=250.0)
    result = identify(model, logged.recording, options=OPTIONS).result
    truth = [logged.truth[logged.names.index(name)] for name in result.base.standard_names]
    return (result.estimates - result.base.values(np.array(truth))) / result.std_errors


@pytest.mark.study
def test_a_four_bar_is_identified_with_honest_errors() -> None:
    assert np.abs(errors_in_sigmas("four-bar", 1)).max() < 4.0


@pytest.mark.study
def test_intervals_hold_the_truth() -> None:
    names = ("four-bar", "piston", "palletizer", "delta")
    found = np.concatenate([errors_in_sigmas(name, seed) for name in names for seed in range(2)])
    assert np.mean(np.abs(found) < 1.96) > 0.93


@pytest.mark.parametrize("name", NAMES)
def test_free_motion_is_that_of_mujoco(name: str) -> None:
    """Accelerations by the shares against MuJoCo's constraint solver."""
    from asbuilt.dynamics import forward_dynamics
    from asbuilt.dynamics.kinematics import draw_postures

    model = robot_with_loops(name)
    physics = Physics(model)
    q = draw_postures(model, np.random.default_rng(0), 5)
    qd = np.random.default_rng(1).normal(size=q.shape)
    still = np.zeros_like(q)
    there, _ = physics.accelerations(q, qd, still, coulomb=still, viscous=still)
    own = forward_dynamics(model, q, qd, still)
    np.testing.assert_allclose(there, own, atol=3e-3 * np.abs(own).max())


@pytest.mark.study
def test_encoders_that_contradict_the_loops_are_named_with_joint_and_time() -> None:
    model = bundled_robot("four-bar")
    motion = random_fourier(model, rng=0, duration=8.0)
    log = VirtualRobot.ideal(model).record(motion, rate=200.0).recording
    assert not any(f.code == "loops_open" for f in check_recording(model, log).findings)
    loop = replace(model.loops[0], point_a=np.array([0.28, 0.0, 0.0]))
    short = replace(model, loops=(loop,))
    (found,) = (f for f in check_recording(short, log).findings if f.code == "loops_open")
    assert found.severity == "error"
    assert found.joint == "crank_joint"
    first = int(np.flatnonzero(~short.closure.postures(log.q).closed)[0])
    assert found.time == pytest.approx(log.t[first], abs=0.01)
    with pytest.raises(RecordingError, match="they do not close at"):
        identify(short, log, options=OPTIONS)


def test_logged_passive_joints_are_compared_with_the_loops() -> None:
    model = bundled_robot("four-bar")
    motion = random_fourier(model, rng=0, duration=8.0)
    log = VirtualRobot.ideal(model).record(motion, rate=200.0).recording
    rocker = model.link_positions(log.q)[:, 2]
    for shift, expected in ((0.0, []), (0.3, ["rocker_joint"])):
        logged = replace(log, extra={**log.extra, "q_rocker_joint": rocker + shift})
        codes = [
            f.joint for f in check_recording(model, logged).findings
            if f.code == "coupling_disagrees"
        ]  # fmt: skip
        assert codes == expected


@pytest.mark.study
def test_designed_motion_keeps_the_loops_closed_and_the_limits() -> None:
    model = robot_with_loops("piston")
    options = DesignOptions(duration=4.0, size=3, starts=1, drive="viscous")
    design = design_motion(model, options, with_bound=False)
    report = check_motion(model, design.motion)
    assert report.is_respected
    q = design.motion.derivative(design.motion.sample_times(1000.0), 0)
    assert model.closure.postures(q).closed.all()


def test_limits_of_passive_joints_count() -> None:
    model = robot_with_loops("piston")
    lever = replace(
        model.followers[0], limits=replace(model.followers[0].limits, lower=-0.1, upper=0.1)
    )
    narrow = replace(model, followers=(lever, *model.followers[1:]))
    motion = random_fourier(model, rng=0, duration=6.0)
    assert check_motion(model, motion).is_respected
    assert {m.joint for m in check_motion(narrow, motion).violations} == {"lever_joint"}


def test_limits_beyond_the_reach_are_refused_before_a_search() -> None:
    model = bundled_robot("four-bar")
    loop = replace(model.loops[0], point_a=np.array([0.28, 0.0, 0.0]))
    # Names of joints may hold spaces.
    crank = replace(model.joints[0], name="crank joint")
    posture = {"crank joint": 1.0, "coupler_joint": -0.3, "rocker_joint": 1.6}
    short = replace(model, loops=(loop,), joints=(crank,), posture=posture)
    with pytest.raises(MotionError, match=r"crank joint -[\d.]+ to [\d.]+") as caught:
        design_motion(short, DesignOptions(duration=4.0))
    assert caught.value.joint == "crank joint"


@pytest.mark.study
@pytest.mark.parametrize("draw", [random_fourier, random_point_to_point])
def test_random_motions_close_the_loops_where_the_limits_do_not(draw) -> None:
    stated = robot_with_loops("piston")
    model = stated.with_limits([replace(stated.joints[0].limits, upper=0.8)])
    with pytest.raises(MotionError, match="closes no loop"):
        link_poses(model, [0.8])
    for seed in range(2):
        motion = draw(model, seed)
        t = motion.sample_times(200.0)
        lever = model.tree.joint_names.index("lever_joint")
        angle = model.joint_map.motion(motion.derivative(t, 0)).q[:, lever]
        # The cylinder's pivot is 0.1 m beside and 0.5 m below the lever's, which is 0.4 m long: the
        # law of cosines gives the distance of its end, which is the piston's length.
        end = np.column_stack([0.4 * np.cos(angle) - 0.1, 0.5 - 0.4 * np.sin(angle)])
        length = motion.derivative(t, 0)[:, 0] + 0.5
        np.testing.assert_allclose(np.linalg.norm(end, axis=1), length, atol=1e-6)


@pytest.mark.study
def test_a_log_of_a_mechanism_with_limits_beyond_its_reach_is_identified() -> None:
    stated = robot_with_loops("piston")
    model = stated.with_limits([replace(stated.joints[0].limits, upper=0.8)])
    log = simulate_recording(stated, random_fourier(stated, rng=1, duration=8.0), rng=1)
    assert not [f for f in check_recording(model, log).findings if f.severity == "error"]
    wide, narrow = (identify(each, log, method="wls").result for each in (model, stated))
    np.testing.assert_allclose(wide.estimates, narrow.estimates, rtol=1e-6, atol=1e-9)


def test_exports_that_have_no_loops_refuse_by_name() -> None:
    model = bundled_robot("four-bar")
    with pytest.raises(DescriptionError, match=r"URDF has no loops.*coupler on rocker"):
        format_urdf(model)
    with pytest.raises(DescriptionError, match=r"C code .*coupler on rocker"):
        Mechanism(model)


def test_a_parallelogram_becomes_mimic_joints_in_urdf() -> None:
    from asbuilt.description.formats.urdf import read_urdf
    from asbuilt.dynamics import inverse_dynamics

    model = bundled_robot("four-bar")
    points = {"point_a": np.array([0.5, 0.0, 0.0]), "point_b": np.array([0.15, 0.0, 0.0])}
    even = replace(
        model,
        loops=(replace(model.loops[0], **points),),
        posture={"crank_joint": 1.0, "coupler_joint": -1.0, "rocker_joint": 1.0},
    )
    read = read_urdf(format_urdf(even))
    assert read.joint_names == ("crank_joint",)
    q = np.linspace(0.4, 2.6, 9)[:, None]
    expected = inverse_dynamics(even, q, 2.0 * q, 3.0 - q)
    np.testing.assert_allclose(inverse_dynamics(read, q, 2.0 * q, 3.0 - q), expected, atol=1e-9)
