"""Verdicts on the numbers of descriptions: recordings of MuJoCo, and brute force."""

import dataclasses

import numpy as np
import pytest

from asbuilt import load_robot, review, simulate_recording
from asbuilt.description import LinkInertia
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import DriveSet, PositionServo, parameter_values
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.validation import CadTolerance
from asbuilt.validation.review.claimed_numbers import (
    ClaimedNumber,
    list_claimed_numbers,
    profile_numbers,
)
from asbuilt.workflow import StudyOptions
from studied_cases import first_of

STEP, RATE = 0.001, 100.0
ROBOT = """
<mujoco model="arm"><option timestep="0.001" integrator="implicitfast"/>
<default><joint damping="{damping}" armature="{armature}" frictionloss="{friction}"/>
<position kp="{kp}" kv="{kv}" forcerange="-9 9"/></default>
<worldbody><body name="a"><joint name="pan" axis="0 0 1"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.1" mass="0.3"/>
<body name="b" pos="0 0 0.1"><joint name="lift" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.25 0 0" mass="0.4"/>
<body name="c" pos="0.25 0 0"><joint name="elbow" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.3"/></body></body></body>
</worldbody><actuator><position joint="pan"/><position joint="lift"/><position joint="elbow"/>
</actuator></mujoco>
"""
TRUTH = {"damping": 0.4, "armature": 0.02, "friction": 0.05, "kp": 15.0, "kv": 0.2}


def described(tmp_path_factory, **changed):
    pytest.importorskip("mujoco")
    file = tmp_path_factory.mktemp("robot") / "arm.xml"
    file.write_text(ROBOT.format(**(TRUTH | changed)))
    return read_mjcf(file)


@pytest.fixture(scope="module")
def recording():
    """A simulation of the true servo arm by MuJoCo."""
    return recorded(9.0)


def recorded(limit):
    """Record the servo arm with a torque limit."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ROBOT.format(**TRUTH))
    model.actuator_forcerange[:] = [-limit, limit]
    model.geom_contype[:] = 0
    model.dof_solref[:], model.dof_solimp[:] = [0.004, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]
    data, per, n = mujoco.MjData(model), round(1.0 / RATE / STEP), 2400
    rng, t = np.random.default_rng(3), np.arange(2400) / RATE
    waves = [
        (rng.uniform(0.1, 0.5) / f, 2.0 * np.pi * f, rng.uniform(0, 6.28))
        for _ in range(3)
        for f in (0.3, 0.55, 0.9, 1.7)
    ]
    u = np.stack(
        [sum(a * np.sin(w * t + p) for a, w, p in waves[4 * k : 4 * k + 4]) for k in range(3)], 1
    )
    q = np.empty((n, 3))
    data.qpos[:] = u[0]
    for k in range(n):
        q[k] = data.qpos
        data.ctrl[:] = u[k]
        for _ in range(per):
            mujoco.mj_step(model, data)
    q += rng.normal(scale=1e-4, size=q.shape)
    return Recording(
        t=t,
        q=q,
        tau=np.zeros_like(q),
        joint_names=("pan", "lift", "elbow"),
        command=u,
        torque_source="command",
    )


def driven(recording, kp, kd):
    return drive_by_command(recording, PositionServo(kp=(kp,) * 3, kd=(kd,) * 3))


def test_true_numbers_are_not_contradicted(recording, tmp_path_factory):
    found = review(described(tmp_path_factory), driven(recording, 15.0, 0.2))
    for claim in found.claims:  # MuJoCo's friction is soft at rest, so its level is biased
        if claim.verdict == "contradicted":
            assert claim.what == "friction loss"
            assert abs(claim.estimate - claim.claimed) < 0.2 * claim.claimed
    for joint in ("lift", "elbow"):
        for what in ("armature", "damping"):
            assert found.of(what, joint).verdict == "supported", (what, joint)
    assert found.of("kp", "lift").note.startswith("given")


def test_wrong_numbers_are_contradicted(recording, tmp_path_factory):
    wrong = described(tmp_path_factory, armature=0.06, damping=0.9, friction=0.2)
    found = review(wrong, driven(recording, 15.0, 0.2))
    for joint in ("lift", "elbow"):
        for what, truth in (("armature", 0.02), ("damping", 0.4), ("friction loss", 0.05)):
            claim = found.of(what, joint)
            assert claim.verdict == "contradicted", (what, joint)
            assert abs(claim.estimate - truth) < 4.0 * claim.std_error + 0.1 * truth
            assert claim.torque > 0.0
    assert [claim.verdict for claim in found.claims[:3]] == ["contradicted"] * 3


@pytest.mark.study
def test_unknown_gains_of_the_servo(recording, tmp_path_factory):
    stiff = described(tmp_path_factory, kp=300.0, kv=2.0)
    found = review(stiff, driven(recording, np.nan, np.nan), options=StudyOptions(same_servos=True))
    for joint in ("pan", "lift", "elbow"):
        stiffness = found.of("kp", joint)
        assert stiffness.verdict == "contradicted"
        assert abs(stiffness.estimate - 15.0) < 4.0 * stiffness.std_error
        with pytest.raises(KeyError):
            found.of("kv", joint)
        assert f"kp of {joint}" in found.of("armature", joint).alias_of
        assert "largest torque" in found.of("forcerange", joint).note
    together = found.of("damping + kv", "lift")
    assert (together.verdict, together.claimed) == ("contradicted", 2.4)
    assert abs(together.estimate - 0.6) < 4.0 * together.std_error + 0.05


@pytest.mark.parametrize(("limit", "contradicted"), first_of(1, [(9.0, True), (4.0, False)]))
def test_a_torque_limit_that_the_command_exceeds_is_judged(limit, contradicted, tmp_path_factory):
    """Claimed is 4 N m; the true arm has 9 or 4 N m."""
    claimed = described(tmp_path_factory)
    joints = [
        dataclasses.replace(joint, limits=dataclasses.replace(joint.limits, torque=4.0))
        for joint in claimed.joints
    ]
    claimed = dataclasses.replace(claimed, joints=tuple(joints))
    found = review(claimed, driven(recorded(limit), 15.0, 0.2))
    claim = found.of("forcerange", "lift")
    assert (claim.verdict == "contradicted") == contradicted
    assert claim.estimate > 4.0
    assert "where the command asks for" in claim.note


@pytest.mark.study
def test_a_value_that_no_robot_has_contradicts_nothing(recording, tmp_path_factory):
    """Torques with a negative armature: the log differs from the claim by many errors."""
    model = described(tmp_path_factory)
    motion = random_fourier(model, 3, duration=20.0, n_harmonics=12)
    drive = DriveSet.parse("armature,viscous,coulomb")
    values = np.tile([-0.2, 0.4, 0.05], 3)
    log = simulate_recording(model, motion, drive=drive, drive_values=values, rng=1)
    claim = review(model, log).of("armature", "elbow")
    assert claim.estimate < -0.15
    assert abs(claim.estimate - claim.claimed) > 10.0 * claim.std_error
    assert (claim.verdict, claim.p_value) == ("undetermined", None)
    assert "another effect" in claim.note


def test_a_centre_beyond_the_robot_contradicts_nothing(recording, tmp_path_factory):
    """A forearm claimed to weigh a tenth would have its centre beyond the arm."""
    file = tmp_path_factory.mktemp("light") / "arm.xml"
    file.write_text(ROBOT.format(**TRUTH).replace('mass="0.3"', 'mass="0.03"'))
    options = StudyOptions(checked=False)
    found = review(read_mjcf(file), driven(recording, 15.0, 0.2), options=options)
    centre = found.of("centre x", "elbow")
    assert centre.estimate > 0.5
    assert (centre.verdict, centre.p_value) == ("undetermined", None)
    assert "another effect" in centre.note
    assert found.of("mass", "elbow").verdict == "contradicted"


@pytest.mark.study
def test_a_value_just_below_zero_is_judged_at_zero(recording, tmp_path_factory):
    model = described(tmp_path_factory)
    motion = random_fourier(model, 3, duration=20.0, n_harmonics=12)
    drive = DriveSet.parse("armature,viscous,coulomb")
    values = np.tile([0.0, 0.4, 0.05], 3)
    log = simulate_recording(model, motion, drive=drive, drive_values=values, rng=1)
    noisy = dataclasses.replace(
        log,
        qd=None,
        qdd=None,
        tau=log.tau + np.random.default_rng(2).normal(0, 0.02, log.tau.shape),
    )
    found = review(model, noisy)
    for joint in ("pan", "lift", "elbow"):
        claim = found.of("armature", joint)
        assert claim.verdict == "contradicted", joint
        assert (claim.note == "tested at zero") == (claim.estimate < 0.0)


def test_armature_and_inertia_about_one_axis_are_aliases():
    model = load_robot("two-link")
    drive = DriveSet.parse("armature,viscous,coulomb")
    log = simulate_recording(model, random_fourier(model, rng=1, duration=20.0), rng=1)
    found = review(model, log, options=StudyOptions(drive=drive))
    first = model.joint_names[0]
    about_axis = found.of("inertia yy", first)
    assert about_axis.verdict == "undetermined"
    assert f"armature of {first}" in about_axis.alias_of


def test_profile_is_least_squares_without_the_row_of_the_number():
    rng = np.random.default_rng(5)
    spreads = [0.3, 0.5, np.inf, 0.2, np.inf]
    numbers = [
        ClaimedNumber("x", str(j), "", 1.0, 1.0, spread, column)
        for j, (spread, column) in enumerate(zip(spreads, np.eye(5), strict=True))
    ]
    K, L = rng.normal(size=(6, 5)), rng.normal(size=(6, 6))
    d, C = rng.normal(size=6), L @ L.T + np.eye(6)
    found = profile_numbers(numbers, K, d, C)
    for j in range(5):
        held = [
            0.0 if k == j or not np.isfinite(spread) else spread**-2
            for k, spread in enumerate(spreads)
        ]
        normal = K.T @ np.linalg.solve(C, K) + np.diag(held)
        x = np.linalg.solve(normal, K.T @ np.linalg.solve(C, d))
        assert found.change[j] == pytest.approx(x[j], rel=1e-4)
        error = np.sqrt(np.linalg.inv(normal)[j, j]) * found.misfit
        assert found.std_error[j] == pytest.approx(error, rel=1e-4)


def test_columns_of_a_body_are_derivatives():
    model = load_robot("two-link")
    numbers = [
        each
        for each in list_claimed_numbers(model, DriveSet(), CadTolerance())
        if each.joint == model.joint_names[1]
    ]
    link = model.links[1].inertia
    for number in numbers:
        h = 1e-4 * number.size
        moved = []
        for step in (-h, h):
            mass, com, about = link.mass, link.com.copy(), link.inertia_about_com.copy()
            kind, _, axes = number.what.partition(" ")
            places = ["xyz".index(axis) for axis in axes]
            if kind == "mass":
                mass += step
            elif kind == "centre":
                com[places[0]] += step
            else:
                about[places[0], places[1]] += step
                if places[0] != places[1]:
                    about[places[1], places[0]] += step
            moved.append(LinkInertia.from_com(mass, com, about).parameters)
        np.testing.assert_allclose(
            (moved[1] - moved[0]) / (2.0 * h), number.column[10:20], atol=1e-6
        )


def test_every_described_number_is_claimed():
    model = load_robot("two-link")
    joint = dataclasses.replace(
        model.joints[0], drive=dataclasses.replace(model.joints[0].drive, viscous=0.25)
    )
    model = dataclasses.replace(model, joints=(joint, *model.joints[1:]))
    drive = DriveSet.parse("viscous")
    numbers = list_claimed_numbers(model, drive, CadTolerance())
    damping = [each for each in numbers if each.what == "damping"]
    assert damping[0].claimed == 0.25
    assert np.isnan(parameter_values(model, drive)[-1]) == np.isnan(damping[1].claimed)


def test_gains_of_a_sliding_joint_are_forces_by_lengths():
    model = load_robot("scara")
    gains = dataclasses.replace(model.joints[0].drive, kp=100.0, kd=2.0)
    joints = tuple(dataclasses.replace(joint, drive=gains) for joint in model.joints)
    motion = random_fourier(model, 3, duration=20.0, n_harmonics=8)
    found = review(
        dataclasses.replace(model, joints=joints), simulate_recording(model, motion, rng=1)
    )
    units = {
        joint.name: (found.of("kp", joint.name).unit, found.of("kv", joint.name).unit)
        for joint in joints
    }
    assert {units[joint.name] for joint in joints if joint.is_revolute} == {
        ("N m/rad", "N m s/rad")
    }
    assert {units[joint.name] for joint in joints if not joint.is_revolute} == {("N/m", "N s/m")}


def test_rollouts_have_no_place_in_a_review():
    with pytest.raises(UsageError, match="rollouts"):
        review("two-link", "log.csv", options=StudyOptions(rollout=(0.5,)))
