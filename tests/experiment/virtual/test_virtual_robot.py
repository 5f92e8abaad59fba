"""A virtual robot must obey MuJoCo and the sensors it states, and what it logs must lead back to
its truth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model

from asbuilt.description import DriveValues, LinkInertia, RobotModel, bundled_robot, robot_names
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import QuinticMotion, random_fourier
from asbuilt.experiment import DataLogger, SensorNoise, VirtualRobot
from asbuilt.experiment.virtual.drive_train import DriveTrain, PositionController
from asbuilt.experiment.virtual.presets import PRESETS
from studied_cases import first_of

CLEAN = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "scara")


@pytest.fixture(scope="module")
def iiwa() -> RobotModel:
    return bundled_robot("kuka-iiwa7-r800")


@pytest.mark.parametrize("name", first_of(1, CLEAN))
def test_ideal_recordings_identify_back_to_the_truth(name: str) -> None:
    model = bundled_robot(name)
    simulated = VirtualRobot.preset("ideal", model).record(random_fourier(model, 6, duration=10.0))
    r = simulated.recording
    assert r.qd is not None
    assert r.qdd is not None
    base = find_base_parameters(model)
    W = observation_matrix(model, r.q, r.qd, r.qdd)[:, base.columns]
    scale = np.linalg.norm(W, axis=0)
    found, _, rank, _ = np.linalg.lstsq(W / scale, r.tau.ravel(), rcond=None)
    truth = base.regrouping @ simulated.truth
    assert rank == base.n_base
    assert np.abs(W @ (found / scale - truth)).max() < 1e-9 * np.abs(r.tau).max()
    assert np.abs(found / scale - truth).max() < 1e-7 * np.abs(truth).max()


def test_the_logged_torque_is_what_pinocchio_says_the_logged_motion_takes(iiwa: RobotModel) -> None:
    """With rotors, friction and offset.

    MuJoCo moved it, Pinocchio judges it, wherever no joint is about to turn round.
    """
    train = DriveTrain(armature=0.3, viscous=2.0, coulomb=1.5, offset=-0.4)
    robot = VirtualRobot(
        model=iiwa, described=iiwa, train=train, logger=DataLogger(rate=200.0, accelerations=True)
    )
    r = robot.record(random_fourier(iiwa, 3, duration=5.0)).recording
    assert r.qd is not None
    assert r.qdd is not None
    other = pinocchio_model(iiwa)
    data = other.createData()
    rigid = np.array(
        [
            pin.rnea(other, data, *map(np.array, state))
            for state in zip(r.q, r.qd, r.qdd, strict=True)
        ]
    )
    expected = rigid + 0.3 * r.qdd + 2.0 * r.qd + 1.5 * np.sign(r.qd) - 0.4
    sliding = np.abs(r.qd) > 5e-3
    assert sliding.mean() > 0.95
    np.testing.assert_allclose(r.tau[sliding], expected[sliding], atol=1e-7)


def test_heavy_friction_on_light_joints_is_followed(iiwa: RobotModel) -> None:
    """As descriptions from strangers have it.

    10 N m s/rad on a light wrist takes its speed away in 0.2 ms.
    """
    model = replace(
        iiwa,
        joints=tuple(
            replace(joint, drive=DriveValues(viscous=10.0, coulomb=1.0)) for joint in iiwa.joints
        ),
    )
    motion = random_fourier(model, 3, duration=2.0)
    r = VirtualRobot.preset("ideal", model).record(motion).recording
    assert r.qd is not None
    assert r.qdd is not None
    assert np.abs(r.q - motion.at(r.t)[0]).max() < 5e-3
    other = pinocchio_model(iiwa)
    data = other.createData()
    rigid = np.array(
        [
            pin.rnea(other, data, *map(np.array, state))
            for state in zip(r.q, r.qd, r.qdd, strict=True)
        ]
    )
    runs = np.abs(r.qd) > 0.05
    assert np.abs(r.tau - rigid - 10.0 * r.qd - np.sign(r.qd))[runs].max() < 1e-3


def test_a_recorded_velocity_is_the_derivative_of_the_recorded_position(iiwa: RobotModel) -> None:
    r = VirtualRobot.preset("ideal", iiwa).record(random_fourier(iiwa, 6, duration=4.0)).recording
    assert r.qd is not None
    assert r.qdd is not None
    h = 1e-3
    np.testing.assert_allclose((r.q[2:] - r.q[:-2]) / (2 * h), r.qd[1:-1], atol=2e-4)
    np.testing.assert_allclose((r.qd[2:] - r.qd[:-2]) / (2 * h), r.qdd[1:-1], atol=0.05)


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        pytest.param(name, preset, marks=[] if k % 3 == j else pytest.mark.study)
        for k, name in enumerate(CLEAN)
        for j, preset in enumerate(PRESETS["mujoco"])
    ],
)
def test_presets_follow_their_command_but_not_exactly(name: str, preset: str) -> None:
    model = bundled_robot(name)
    r = (
        VirtualRobot.preset(preset, model, rng=1)
        .record(random_fourier(model, 2, duration=3.0), rng=3)
        .recording
    )
    error = np.abs(r.q - r.extra["q_command"]).max()
    assert 1e-8 < error < {"ideal": 1e-3, "servo": 1.5}.get(preset, 0.05)
    assert np.all(np.isfinite(r.tau))
    assert f"'{preset}'" in r.notes[0]


def test_lab_and_factory_stay_physical() -> None:
    for name in CLEAN:
        for preset in ("lab", "factory"):
            robot = VirtualRobot.preset(preset, bundled_robot(name), rng=5)
            assert all(link.inertia.is_consistent for link in robot.model.links)
            assert np.linalg.norm(robot.model.gravity) == pytest.approx(9.81)
            assert robot.drive == DriveSet.parse(
                "viscous,coulomb,offset" if preset == "lab" else "armature,viscous,coulomb,offset"
            )
            assert robot.truth.shape == (
                (10 + robot.drive.columns_per_joint) * robot.model.n_joints,
            )


def test_the_same_seed_gives_the_same_recording(iiwa: RobotModel) -> None:
    motion = random_fourier(iiwa, 1, duration=1.0)
    first, second, third = (
        VirtualRobot.preset("factory", iiwa, rng=3).record(motion, rng=seed).recording
        for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(first.tau, second.tau)
    np.testing.assert_array_equal(first.t, second.t)
    assert not np.array_equal(first.tau, third.tau)


def test_a_sensor_behind_the_gear_feels_no_rotor_and_part_of_the_friction(iiwa: RobotModel) -> None:
    motion = random_fourier(iiwa, 1, duration=3.0)
    train = DriveTrain(armature=0.4, viscous=3.0, coulomb=2.0)
    motor, sensor = (
        VirtualRobot(
            model=iiwa,
            described=iiwa,
            train=train,
            torque=torque,
            behind=0.25,
            logger=DataLogger(accelerations=True),
        ).record(motion)
        for torque in ("motor", "sensor")
    )
    r = motor.recording
    assert r.qd is not None
    assert r.qdd is not None
    np.testing.assert_array_equal(r.q, sensor.recording.q)
    sliding = np.abs(r.qd) > 2e-2
    expected = 0.4 * r.qdd + 0.75 * (3.0 * r.qd + 2.0 * np.sign(r.qd))
    np.testing.assert_allclose(
        (r.tau - sensor.recording.tau)[sliding], expected[sliding], atol=1e-7
    )
    W = observation_matrix(iiwa, r.q, r.qd, r.qdd, drive=sensor.drive)
    np.testing.assert_allclose(
        (W @ sensor.truth).reshape(r.tau.shape)[sliding], sensor.recording.tau[sliding], atol=1e-7
    )


def test_stribeck_friction_is_larger_at_low_speed_and_falls_as_the_gear_warms_up() -> None:
    model = bundled_robot("two-link").with_gravity([0.0, 0.0, 0.0])
    train = DriveTrain(
        armature=0.5,
        coulomb=2.0,
        stiction=1.0,
        stribeck_velocity=0.05,
        warming=0.5,
        warming_time=1.0,
    )
    robot = VirtualRobot(model=model, described=model, train=train)
    moved, _ = robot.follow(QuinticMotion.between([0.0, 0.0], [1.0, -1.0], 6.0))
    expected = (
        np.sign(moved.qd)
        * (2.0 + np.exp(-((moved.qd / 0.05) ** 2)))
        * (1 - 0.5 * (1 - np.exp(-moved.t / 1.0)))[:, None]
    )
    sliding = np.abs(moved.qd) > 5e-3
    np.testing.assert_allclose(moved.friction[sliding], expected[sliding], atol=1e-6)
    assert np.ptp(np.abs(moved.friction[sliding])) > 1.0


def test_backlash_moves_the_encoder_with_the_sign_of_the_torque(iiwa: RobotModel) -> None:
    train = DriveTrain(backlash=1e-3, engagement=0.5)
    q, tau = np.zeros((3, 7)), np.array([[-50.0], [0.0], [50.0]]) * np.ones(7)
    np.testing.assert_allclose(train.motor_position(q, tau)[:, 0], [-5e-4, 0.0, 5e-4], atol=1e-12)
    robot = VirtualRobot(
        model=iiwa, described=iiwa, train=train, logger=DataLogger(accelerations=True)
    )
    motion = random_fourier(iiwa, 1, duration=2.0)
    moved, _ = robot.follow(motion)
    lag = robot.record(motion).recording.q - moved.q
    np.testing.assert_allclose(lag, 5e-4 * np.tanh(moved.motor / 0.5), atol=1e-12)


def test_ripple_gain_and_clock_are_as_stated(iiwa: RobotModel) -> None:
    motion = random_fourier(iiwa, 1, duration=6.0)
    plain = VirtualRobot(model=iiwa, described=iiwa, logger=DataLogger(accelerations=True))
    truth = plain.record(motion).recording
    rippled = (
        replace(plain, sensors=SensorNoise(torque_gain=1.1, torque_ripple=0.3, ripple_cycles=5.0))
        .record(motion, rng=1)
        .recording
    )
    wave = rippled.tau - 1.1 * truth.tau
    columns = np.stack([np.sin(5 * truth.q[:, 0]), np.cos(5 * truth.q[:, 0])], axis=1)
    fit, residual, *_ = np.linalg.lstsq(columns, wave[:, 0], rcond=None)
    assert np.hypot(*fit) == pytest.approx(0.3, rel=1e-9)
    assert residual[0] < 1e-18 * wave.shape[0]
    logged = (
        replace(plain, logger=DataLogger(rate=250.0, clock_jitter=1e-4, dropped=0.1, burst=4.0))
        .record(motion, rng=1)
        .recording
    )
    steps = np.diff(logged.t)
    assert np.all(steps > 0)
    assert 0.04 < 1 - logged.n_samples / 1501 < 0.18
    nominal = np.round(logged.t * 250) / 250
    assert (logged.t - nominal).std() == pytest.approx(1e-4, rel=0.15)
    rows = np.round(nominal * 1000).astype(int)
    np.testing.assert_array_equal(logged.q, truth.q[rows])


def test_a_tool_is_carried_and_not_known_to_the_controller() -> None:
    model = bundled_robot("ur10e")
    tool = LinkInertia.from_com(3.0, [0.0, 0.02, 0.08], np.eye(3) * 0.01)
    robot = VirtualRobot.preset("ideal", model, tool=tool, at="flange")
    assert sum(link.inertia.mass for link in robot.model.links) == pytest.approx(
        sum(link.inertia.mass for link in model.links) + 3.0
    )
    assert robot.described is model
    motion = random_fourier(model, 1, duration=2.0)
    bare, loaded = (
        r.record(motion).recording for r in (VirtualRobot.preset("ideal", model), robot)
    )
    sag, none = (np.abs(r.q - r.extra["q_command"]).max() for r in (loaded, bare))
    assert sag > 10 * none


@pytest.mark.parametrize("name", robot_names())
def test_every_bundled_robot_can_be_recorded(name: str) -> None:
    model = bundled_robot(name)
    simulated = VirtualRobot.preset("lab", model, rng=0).record(
        random_fourier(model, 1, duration=1.0), rng=0
    )
    assert simulated.recording.n_samples == 1001


def test_errors_say_what_is_wrong(iiwa: RobotModel) -> None:
    with pytest.raises(
        UsageError,
        match=(
            "there is no virtual robot 'shop' on the engine mujoco; there are ideal, lab, factory"
        ),
    ):
        VirtualRobot.preset("shop", iiwa)
    with pytest.raises(UsageError, match="the motion moves 1 joints, kuka-iiwa7-r800 has 7"):
        VirtualRobot.preset("ideal", iiwa).record(QuinticMotion.between([0.0], [1.0], 1.0))
    with pytest.raises(
        UsageError, match="coulomb must be one non-negative number or one per joint"
    ):
        VirtualRobot(model=iiwa, described=iiwa, train=DriveTrain(coulomb=-1.0))
    with pytest.raises(
        UsageError, match="armature must be one non-negative number or one per joint"
    ):
        VirtualRobot(model=iiwa, described=iiwa, train=DriveTrain(armature=(1.0, 2.0)))
    with pytest.raises(UsageError, match="must be at most a twentieth, 50 Hz, got 80 Hz"):
        PositionController(bandwidth=80.0)
    with pytest.raises(UsageError, match="clock_jitter must be below half a sampling period"):
        DataLogger(clock_jitter=1.0)
    with pytest.raises(UsageError, match="warming must be from 0"):
        DriveTrain(warming=1.0)
    heavy = LinkInertia.from_com(300.0, [0.0, 0.0, 0.3], np.eye(3))
    with pytest.raises(
        MotionError,
        match=r"joint .* does not follow the command .* torque limit is .*; slow the motion down",
    ):
        VirtualRobot.preset("ideal", iiwa, tool=heavy).record(random_fourier(iiwa, 1, duration=2.0))
