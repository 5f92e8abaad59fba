"""A virtual robot must move as Pinocchio says, and its truth must be what least squares finds."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from asbuilt.description import LinkInertia, RobotModel, bundled_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.errors import UsageError
from asbuilt.excitation import QuinticMotion, random_fourier
from asbuilt.experiment import SensorNoise, VirtualRobot, simulate_recording
from asbuilt.experiment.virtual.presets import perturb_links

ALL_DRIVES = DriveSet.parse("armature,viscous,coulomb,offset")


@pytest.fixture(scope="module")
def iiwa() -> RobotModel:
    return bundled_robot("kuka-iiwa7-r800")


def pinocchio_of(model: RobotModel) -> tuple[pin.Model, pin.Data]:
    """The same arm in Pinocchio, joint i at `after[i - 1] @ before[i]`, bodies at `after[i]`."""
    other = pin.Model()
    other.gravity.linear = np.array(model.gravity)
    ids: list[int] = []
    for joint, link in zip(model.joints, model.links, strict=True):
        parent = 0 if joint.parent < 0 else ids[joint.parent]
        before = (
            joint.before if joint.parent < 0 else model.joints[joint.parent].after @ joint.before
        )
        kind = pin.JointModelRZ() if joint.is_revolute else pin.JointModelPZ()
        ids.append(
            other.addJoint(
                parent, kind, pin.SE3(before[:3, :3].copy(), before[:3, 3].copy()), joint.name
            )
        )
        mass, com = link.inertia.mass, link.inertia.com
        body = pin.Inertia(mass, com, link.inertia.inertia_about_com)
        other.appendBodyToJoint(
            ids[-1], body, pin.SE3(joint.after[:3, :3].copy(), joint.after[:3, 3].copy())
        )
    return other, other.createData()


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "franka-panda"])
def test_noise_free_recording_is_that_of_pinocchio(name: str) -> None:
    model = bundled_robot(name)
    motion = random_fourier(model, 1, duration=3.0)
    tool = LinkInertia.from_com(1.5, [0.02, -0.01, 0.1], np.diag([0.01, 0.02, 0.015]))
    recording = simulate_recording(model, motion, rate=50, drive=DriveSet(), tool=tool)
    carrying = VirtualRobot.ideal(model).with_tool(tool).model
    other, data = pinocchio_of(carrying)
    assert recording.qd is not None
    assert recording.qdd is not None
    expected = [
        pin.rnea(other, data, *(np.array(x) for x in state))
        for state in zip(recording.q, recording.qd, recording.qdd, strict=True)
    ]
    np.testing.assert_allclose(recording.tau, expected, atol=1e-10)
    np.testing.assert_array_equal(recording.q, motion.sample(50).q)


def test_tool_in_pinocchio_is_the_same_tool(iiwa: RobotModel) -> None:
    """The tool appended by Pinocchio itself, at a frame turned against the link."""
    tool = LinkInertia.from_com(1.5, [0.02, -0.01, 0.1], np.diag([0.01, 0.02, 0.015]))
    other, data = pinocchio_of(iiwa)
    frame = next(frame for frame in iiwa.frames if frame.link == 6)
    placement = iiwa.joints[6].after @ frame.placement
    body = pin.Inertia(tool.mass, tool.com, tool.inertia_about_com)
    other.appendBodyToJoint(7, body, pin.SE3(placement[:3, :3].copy(), placement[:3, 3].copy()))
    robot = VirtualRobot.ideal(iiwa).with_tool(tool, frame.name)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 20, 7))
    expected = [
        pin.rnea(other, data, *(x.copy() for x in state)) for state in zip(q, qd, qdd, strict=True)
    ]
    np.testing.assert_allclose(robot.exact_torque(q, qd, qdd), expected, atol=1e-10)
    assert robot.model.links[6].parts[-1][0] == "tool"


def test_tilting_the_robot_turns_its_root_against_the_world(iiwa: RobotModel) -> None:
    roll, pitch = 0.02, -0.03
    other, data = pinocchio_of(iiwa)
    root = pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, 0.0), np.zeros(3))
    other.jointPlacements[1] = root * other.jointPlacements[1]
    robot = VirtualRobot.ideal(iiwa).tilted(roll, pitch)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 20, 7))
    expected = [
        pin.rnea(other, data, *(x.copy() for x in state)) for state in zip(q, qd, qdd, strict=True)
    ]
    np.testing.assert_allclose(robot.exact_torque(q, qd, qdd), expected, atol=1e-10)


def test_least_squares_on_a_noise_free_recording_finds_the_truth(iiwa: RobotModel) -> None:
    """The minimum-norm solution and the truth differ only along directions that no motion shows."""
    robot = VirtualRobot.typical(iiwa, rng=5).with_noise(SensorNoise())
    simulated = robot.record(random_fourier(iiwa, 6, duration=20.0), rate=20)
    r = simulated.recording
    assert r.qd is not None
    assert r.qdd is not None
    W = observation_matrix(
        iiwa.with_gravity(robot.model.gravity), r.q, r.qd, r.qdd, drive=robot.drive
    )
    scale = np.linalg.norm(W, axis=0)
    scale[scale == 0] = 1.0
    found, _, rank, _ = np.linalg.lstsq(W / scale, r.tau.ravel(), rcond=1e-10)
    rng = np.random.default_rng(9)
    q, qd, qdd = rng.uniform(-1.5, 1.5, size=(3, 50, 7))
    fresh = observation_matrix(robot.model, q, qd, qdd, drive=robot.drive)
    seen = fresh @ (found / scale)
    expected = fresh @ simulated.truth
    assert np.abs(seen - expected).max() < 1e-9 * np.abs(expected).max()
    assert 43 + 21 < rank <= 73
    np.testing.assert_allclose(robot.exact_torque(q, qd, qdd).ravel(), expected, atol=1e-9)
    drives = [k for k, name in enumerate(simulated.names) if name.startswith(("Fv", "Fc", "Fo"))]
    np.testing.assert_allclose(
        (found / scale)[drives], simulated.truth[drives], rtol=1e-7, atol=1e-9
    )


def test_base_parameters_of_the_truth_are_found_to_nine_digits(iiwa: RobotModel) -> None:
    drive = DriveSet.parse("viscous,coulomb,offset")
    values = np.random.default_rng(3).uniform(0.1, 2.0, size=21)
    perturbed = perturb_links(iiwa, 0.05, np.random.default_rng(2))
    robot = VirtualRobot.ideal(perturbed).with_drive(drive, values)
    simulated = robot.record(random_fourier(iiwa, 6, duration=20.0), rate=20)
    r = simulated.recording
    assert r.qd is not None
    assert r.qdd is not None
    base = find_base_parameters(iiwa, drive)
    W = observation_matrix(iiwa, r.q, r.qd, r.qdd, drive=drive)[:, base.columns]
    found, _, rank, _ = np.linalg.lstsq(W, r.tau.ravel(), rcond=None)
    assert rank == base.n_base == 43 + 21
    truth = base.regrouping @ simulated.truth
    assert np.abs(found - truth).max() < 1e-9 * np.abs(truth).max()


def test_the_same_seed_gives_the_same_recording_and_robot(iiwa: RobotModel) -> None:
    motion = random_fourier(iiwa, 1, duration=2.0)
    first, second = (
        VirtualRobot.typical(iiwa, rng=3).record(motion, rate=100, rng=4) for _ in range(2)
    )
    np.testing.assert_array_equal(first.recording.tau, second.recording.tau)
    np.testing.assert_array_equal(first.recording.q, second.recording.q)
    np.testing.assert_array_equal(first.truth, second.truth)
    other = VirtualRobot.typical(iiwa, rng=3).record(motion, rate=100, rng=5)
    assert np.abs(other.recording.tau - first.recording.tau).max() > 0
    assert "seed 4" in first.recording.notes[0]
    generator = VirtualRobot.typical(iiwa, np.random.default_rng(3)).record(
        motion, rate=100, rng=np.random.default_rng(4)
    )
    np.testing.assert_array_equal(generator.recording.tau, first.recording.tau)


def test_sensors_distort_as_stated(iiwa: RobotModel) -> None:
    motion = QuinticMotion.between(np.full(7, 0.3), np.full(7, 0.5), 10.0)
    noise = SensorNoise(
        position_noise=1e-3,
        torque_noise=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7),
        torque_bias=-1.0,
        velocity_noise=0.01,
    )
    truth = simulate_recording(iiwa, motion)
    noisy = simulate_recording(iiwa, motion, noise=noise, rng=8)
    n = truth.n_samples
    error = noisy.tau - truth.tau
    np.testing.assert_allclose(error.std(axis=0), np.arange(1, 8) / 10, rtol=5 / np.sqrt(n))
    np.testing.assert_allclose(error.mean(axis=0), -1.0, atol=5 * 0.7 / np.sqrt(n))
    np.testing.assert_allclose((noisy.q - truth.q).std(axis=0), 1e-3, rtol=5 / np.sqrt(n))
    assert noisy.qd is not None
    np.testing.assert_allclose((noisy.qd - truth.qd).std(axis=0), 0.01, rtol=5 / np.sqrt(n))
    assert noisy.qdd is None
    rounded = simulate_recording(
        iiwa, motion, noise=SensorNoise(encoder_counts=4096, torque_resolution=0.5), rng=8
    )
    counts, steps = rounded.q * 4096 / (2 * np.pi), rounded.tau / 0.5
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(rounded.q - truth.q).max() <= np.pi / 4096 * (1 + 1e-9)
    assert rounded.qd is None


def test_quantisation_counts_per_metre_on_a_sliding_joint() -> None:
    from asbuilt.description import Joint, Link

    slide = RobotModel(
        "slide",
        (Joint("z", "prismatic", -1, np.eye(4), np.eye(4)),),
        (Link("load", LinkInertia.from_com(2.0, np.zeros(3), np.eye(3))),),
    )
    recording = simulate_recording(
        slide,
        QuinticMotion.between([0.0], [0.1], 1.0),
        noise=SensorNoise(encoder_counts=1000),
        rng=0,
    )
    np.testing.assert_allclose(recording.q * 1000, np.round(recording.q * 1000), atol=1e-9)
    assert np.unique(recording.q).size == 101


def test_drive_torque_is_the_sum_of_its_terms(iiwa: RobotModel) -> None:
    motion = random_fourier(iiwa, 1, duration=4.0)
    values = np.random.default_rng(0).uniform(0.1, 2.0, size=(7, 4))
    plain = simulate_recording(iiwa, motion, drive=DriveSet())
    full = simulate_recording(iiwa, motion, drive=ALL_DRIVES, drive_values=values.ravel())
    s = motion.sample(1000)
    expected = (
        s.qdd * values[:, 0] + s.qd * values[:, 1] + np.sign(s.qd) * values[:, 2] + values[:, 3]
    )
    np.testing.assert_allclose(full.tau - plain.tau, expected, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "franka-panda", "two-link"])
def test_typical_robot_is_consistent_and_near_its_description(name: str, seed: int) -> None:
    model = bundled_robot(name)
    robot = VirtualRobot.typical(model, rng=seed)
    assert [link.inertia.is_consistent for link in robot.model.links] == [True] * model.n_joints
    masses = [sum(link.inertia.mass for link in m.links) for m in (model, robot.model)]
    assert masses[1] == pytest.approx(1.03 * masses[0], rel=0.1)
    assert np.linalg.norm(robot.model.gravity) == pytest.approx(9.81)
    values = np.reshape(robot.drive_values, (model.n_joints, 4))
    assert np.all(values[:, :3] > 0)
    motion = random_fourier(model, seed, duration=5.0)
    simulated = robot.record(motion, rate=100, rng=seed)
    plain = simulate_recording(model, motion, rate=100, drive=DriveSet())
    difference = np.linalg.norm(simulated.recording.tau - plain.tau) / np.linalg.norm(plain.tau)
    assert 0.01 < difference < 0.6


def test_errors_say_what_to_give(iiwa: RobotModel) -> None:
    motion = QuinticMotion.between(np.zeros(7), np.ones(7), 1.0)
    with pytest.raises(
        UsageError,
        match=(r"drive parameter Fv1 of .* has no value in the description; give the values"),
    ):
        simulate_recording(iiwa, motion, drive=DriveSet.parse("viscous"))
    with pytest.raises(UsageError, match="has 7 drive parameters, got shape"):
        simulate_recording(iiwa, motion, drive=DriveSet.parse("viscous"), drive_values=[1.0])
    with pytest.raises(UsageError, match="given without drive"):
        simulate_recording(iiwa, motion, drive_values=[1.0] * 7)
    with pytest.raises(UsageError, match="moves 1 joints"):
        simulate_recording(iiwa, QuinticMotion.between([0.0], [1.0], 1.0))
    with pytest.raises(
        UsageError, match="torque_noise must be one non-negative number or one per joint"
    ):
        simulate_recording(iiwa, motion, noise=SensorNoise(torque_noise=-1.0))
    with pytest.raises(UsageError, match="no moving link or frame 'hand' to carry a tool; it has"):
        VirtualRobot.ideal(iiwa).with_tool(LinkInertia.zero(), "hand")
