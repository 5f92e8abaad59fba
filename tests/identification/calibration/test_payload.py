"""The payload: found again in simulations that another road made, told from what no motion tells,
and weighed on a real arm.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from asbuilt.description import Frame, LinkInertia, load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.excitation import FourierMotion, random_fourier
from asbuilt.experiment import (
    Samples,
    SensorNoise,
    SignalChain,
    VirtualRobot,
    prepare_samples,
    read_recordings,
    resolve_chain,
)
from asbuilt.identification import (
    IdentificationResult,
    Payload,
    choose_payload_frame,
    identify_payload_samples,
    identify_samples,
)
from asbuilt.identification.information.cause_data import gather_cause_data

TOOL = LinkInertia.from_com(
    1.8,
    [0.03, -0.02, 0.09],
    np.array([[0.011, 0.001, 0.0], [0.001, 0.009, 0.0005], [0.0, 0.0005, 0.006]]),
)
DRIVE = DriveSet.parse("viscous,coulomb,offset")
ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda")


def prepared(robot: VirtualRobot, seed: int, duration: float = 20.0) -> Samples:
    motion = random_fourier(robot.model, rng=seed, duration=duration, n_harmonics=10)
    return prepare_samples(robot.record(motion, rate=200.0, rng=seed).recording)


def arm_of(name: str, noise: float) -> VirtualRobot:
    model = load_robot(name)
    values = np.tile([1.0, 2.0, 0.3], model.n_joints)
    return (
        VirtualRobot.ideal(model)
        .with_drive(DRIVE, values)
        .with_noise(SensorNoise(torque_noise=noise))
    )


@pytest.fixture(scope="module", params=ROBOTS)
def weighed(request: pytest.FixtureRequest) -> tuple[IdentificationResult, Payload, Payload]:
    robot = arm_of(request.param, 0.05)
    result = identify_samples(robot.model, [prepared(robot, 1), prepared(robot, 2)], drive=DRIVE)
    frame, _, _ = choose_payload_frame(robot.model)
    loaded = prepared(robot.with_tool(TOOL, at=frame), 3)
    return (
        result,
        identify_payload_samples(result, loaded),
        identify_payload_samples(result, loaded, arm="frozen"),
    )


def test_payload_is_found_within_its_errors(
    weighed: tuple[IdentificationResult, Payload, Payload],
) -> None:
    _, refined, frozen = weighed
    about = TOOL.inertia_about_com[np.triu_indices(3)]
    truth = np.concatenate([[TOOL.mass], TOOL.com, about])
    for payload in (refined, frozen):
        assert np.all(np.abs(payload.values - truth) < 4.5 * payload.std_errors + 1e-4)
        assert payload.values[0] == pytest.approx(TOOL.mass, rel=0.02)
        assert payload.values[1:4] == pytest.approx(TOOL.com, abs=0.01)
        assert {"mass", "com_x", "com_y", "com_z"} <= set(payload.determined)
        assert set(payload.determined) | set(payload.not_determined) == set(payload.names)
        assert payload.inertia.is_consistent


def test_payload_explains_the_loaded_torque(
    weighed: tuple[IdentificationResult, Payload, Payload],
) -> None:
    _, refined, _ = weighed
    assert refined.metrics[0].relative_error < 0.3 * refined.metrics_bare[0].relative_error


def exact(machine: VirtualRobot, motion: FourierMotion) -> Samples:
    moved = motion.sample(100.0)
    tau = machine.exact_torque(moved.q, moved.qd, moved.qdd)
    return Samples(
        moved.t,
        moved.q,
        moved.qd,
        moved.qdd,
        tau,
        rate=100.0,
        joint_names=machine.model.joint_names,
    )


def test_noise_free_payload_is_exact() -> None:
    robot = arm_of("kuka-iiwa7-r800", 0.0)
    motion = random_fourier(robot.model, rng=4, duration=10.0)
    result = identify_samples(robot.model, exact(robot, motion), drive=DRIVE)
    frame, _, placement = choose_payload_frame(robot.model)
    assert frame == "flange"
    np.testing.assert_allclose(
        placement, next(f.placement for f in robot.model.frames if f.name == "flange")
    )
    payload = identify_payload_samples(
        result, exact(robot.with_tool(TOOL, at=frame), motion), arm="frozen"
    )
    np.testing.assert_allclose(payload.parameters, TOOL.parameters, atol=1e-8)
    assert not payload.projected


def test_friction_under_load_feels_the_payload() -> None:
    model = load_robot("ur10e")
    drive = DriveSet.parse("viscous,coulomb,load_friction,offset")
    robot = VirtualRobot.ideal(model).with_drive(drive, np.tile([1.0, 2.0, 0.15, 0.3], 6))
    motion = random_fourier(model, rng=4, duration=10.0)
    frame, _, _ = choose_payload_frame(model)
    result = identify_samples(model, exact(robot, motion), drive=drive)
    payload = identify_payload_samples(
        result, exact(robot.with_tool(TOOL, at=frame), motion), arm="frozen"
    )
    np.testing.assert_allclose(payload.parameters[6:], TOOL.parameters[6:], atol=1e-3)
    assert payload.metrics[0].relative_error < 1e-4


def test_a_recording_that_is_lighter_than_the_arm_is_refused() -> None:
    robot = arm_of("ur10e", 0.05)
    result = identify_samples(robot.model, prepared(robot.with_tool(TOOL), 1), drive=DRIVE)
    with pytest.raises(IdentifiabilityError, match="expected a positive mass"):
        identify_payload_samples(result, prepared(robot, 2))


def test_what_a_scara_cannot_tell_has_errors_to_match() -> None:
    robot = arm_of("scara", 0.05)
    result = identify_samples(robot.model, prepared(robot, 1), drive=DRIVE)
    payload = identify_payload_samples(result, prepared(robot.with_tool(TOOL), 2))
    assert payload.values[0] == pytest.approx(TOOL.mass, rel=0.1)
    assert {"com_z", "Ixx", "Iyy"} <= set(payload.not_determined)


@pytest.mark.parametrize("still", [(6,), (5, 6)])
def test_an_arm_whose_wrist_stood_still_weighs_all_the_same(still: tuple[int, ...]) -> None:
    """What the bare arm's motion left open - friction of joints that stood - is found along with
    the payload; a frozen arm cannot know it.
    """
    robot = arm_of("kuka-iiwa7-r800", 0.0)
    bare = exact(robot, random_fourier(robot.model, rng=4, duration=10.0))
    q, qd, qdd = (np.array(values) for values in (bare.q, bare.qd, bare.qdd))
    q[:, still], qd[:, still], qdd[:, still] = 0.3, 0.0, 0.0
    noise = 0.05 * np.random.default_rng(0).normal(size=(2, *q.shape))
    stood = replace(
        bare,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=robot.exact_torque(q, qd, qdd) + noise[0],
        tau_raw=np.zeros(0),
    )
    frame, _, _ = choose_payload_frame(robot.model)
    loaded = exact(
        robot.with_tool(TOOL, at=frame), random_fourier(robot.model, rng=5, duration=10.0)
    )
    loaded = replace(loaded, tau=loaded.tau + noise[1], tau_raw=np.zeros(0))
    result = identify_samples(robot.model, stood, drive=DRIVE)
    assert "Fv7" in result.undetermined
    payload = identify_payload_samples(result, replace(loaded, torque_source="current"))
    truth = np.concatenate([[TOOL.mass], TOOL.com, TOOL.inertia_about_com[np.triu_indices(3)]])
    assert np.all(np.abs(payload.values - truth) < 4.5 * payload.noise_errors + 1e-4)
    assert payload.values[0] == pytest.approx(TOOL.mass, rel=0.02)
    assert np.all(np.isfinite(payload.gain_errors))
    friction = payload.arm[[result.base.names.index(name) for name in ("Fv7", "Fc7")]]
    np.testing.assert_allclose(friction, [1.0, 2.0], atol=0.1)
    with pytest.raises(IdentifiabilityError, match="result of the arm does not determine"):
        identify_payload_samples(result, loaded, arm="frozen")


def test_the_frame_of_the_payload_is_named_by_words_and_not_by_chance() -> None:
    model = load_robot("two-link")
    pose = np.eye(4)

    def chosen(*names: str) -> str:
        return choose_payload_frame(
            replace(model, frames=tuple(Frame(name, 1, pose) for name in names))
        )[0]

    assert chosen("cable_sleeve", "steel-bracket") == model.link_names[1]
    assert chosen("cable_sleeve", "arm_ee_link") == "arm_ee_link"
    assert chosen("panda.EE", "TCP") == "panda.EE"
    assert chosen("link_ee", "tool0", "toolflange") == "toolflange"


def test_unknown_frame_lists_the_known_ones() -> None:
    with pytest.raises(UsageError, match="flange"):
        choose_payload_frame(load_robot("kuka-iiwa7-r800"), "gripper")


def test_a_pose_held_still_tells_no_payload() -> None:
    robot = arm_of("ur10e", 0.0)
    result = identify_samples(robot.model, prepared(robot, 1), drive=DRIVE)
    q = np.tile([0.3, -1.0, 0.8, 0.2, 0.4, 0.1], (400, 1))
    still = Samples(
        np.arange(400) / 100.0,
        q,
        0 * q,
        0 * q,
        robot.exact_torque(q, 0 * q, 0 * q),
        rate=100.0,
        joint_names=robot.model.joint_names,
    )
    with pytest.raises(IdentifiabilityError, match="different poses"):
        identify_payload_samples(result, still, arm="frozen")
    with pytest.raises(UsageError, match="no samples of ur10e under load"):
        identify_payload_samples(result, [])


def scaled(samples: Samples, factors: np.ndarray) -> Samples:
    """Return samples whose torques were logged with gains off by these factors."""
    return replace(samples, tau=samples.tau * factors, torque_source="current")


@pytest.fixture(scope="module", params=("ur10e",))
def by_current(request: pytest.FixtureRequest) -> tuple[VirtualRobot, Samples, Samples, str]:
    robot = arm_of(request.param, 0.1)
    frame, _, _ = choose_payload_frame(robot.model)
    return robot, prepared(robot, 1, 30.0), prepared(robot.with_tool(TOOL, at=frame), 3), frame


@pytest.mark.parametrize("arm", [pytest.param("refined", marks=pytest.mark.study), "frozen"])
def test_what_gains_do_to_a_payload_is_seen_by_changing_them(
    by_current: tuple[VirtualRobot, Samples, Samples, str], arm: Literal["refined", "frozen"]
) -> None:
    robot, bare, loaded, _ = by_current
    n = robot.model.n_joints

    reference = identify_samples(robot.model, bare, drive=DRIVE, method="ols")

    def found(factors: np.ndarray, keep_evidence: bool) -> Payload:
        result = identify_samples(robot.model, scaled(bare, factors), drive=DRIVE, method="ols")
        result = replace(result, sigma=np.full(n, 0.1), covariance=reference.covariance)
        if keep_evidence:
            result = replace(
                result,
                cause_data=gather_cause_data(robot.model, result.base, [scaled(bare, factors)]),
            )
        return identify_payload_samples(result, scaled(loaded, factors), arm=arm)

    payload = found(np.ones(n), True)
    np.testing.assert_allclose(
        payload.gain_slopes[:4].sum(axis=1), [payload.values[0], 0.0, 0.0, 0.0], atol=0.02
    )
    assert not payload.projected
    seen = np.column_stack(
        [(found(1.0 + 1e-5 * np.eye(n)[k], False).values - payload.values) / 1e-5 for k in range(n)]
    )
    np.testing.assert_allclose(payload.gain_slopes, seen, atol=1e-3)
    without = found(np.ones(n), False)
    assert (payload.gains_by_evidence, without.gains_by_evidence) == (True, False)
    np.testing.assert_allclose(without.gain_errors[0], payload.gain_errors[0], rtol=0.5)


@pytest.mark.study
def test_random_gains_are_covered(by_current: tuple[VirtualRobot, Samples, Samples, str]) -> None:
    robot, bare, loaded, _ = by_current
    n, rng = robot.model.n_joints, np.random.default_rng(8)
    off = []
    for _ in range(16):
        factors = 1.0 + 0.07 * (
            np.sqrt(1.0 / 3.0) * rng.normal() + np.sqrt(2.0 / 3.0) * rng.normal(size=n)
        )
        result = identify_samples(robot.model, scaled(bare, factors), drive=DRIVE)
        result = replace(
            result, cause_data=gather_cause_data(robot.model, result.base, [scaled(bare, factors)])
        )
        payload = identify_payload_samples(result, scaled(loaded, factors))
        off.append((payload.values[:4] - np.array([TOOL.mass, *TOOL.com])) / payload.std_errors[:4])
    assert 0.85 < np.mean(np.abs(off) < 1.96) <= 1.0
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_gains_of_sensors_are_not_questioned(
    by_current: tuple[VirtualRobot, Samples, Samples, str],
) -> None:
    robot, bare, loaded, _ = by_current
    result = identify_samples(robot.model, bare, drive=DRIVE)
    ones = np.ones(robot.model.n_joints)
    sensor = identify_payload_samples(result, replace(loaded, torque_source="sensor"))
    exact = identify_payload_samples(result, scaled(loaded, ones), gain_uncertainty=0.0)
    current = identify_payload_samples(result, scaled(loaded, ones))
    for payload in (sensor, exact):
        np.testing.assert_array_equal(payload.gain_errors, 0.0)
        np.testing.assert_array_equal(payload.std_errors, payload.noise_errors)
    # Weights settle to 1e-8, which the errors of the payload magnify.
    np.testing.assert_allclose(current.noise_errors[:4], sensor.std_errors[:4], rtol=1e-6)
    np.testing.assert_allclose(
        current.std_errors, np.hypot(current.noise_errors, current.gain_errors)
    )
    half = identify_payload_samples(
        result, scaled(loaded, ones), gain_uncertainty=np.full(len(ones), 0.035)
    )
    np.testing.assert_allclose(half.gain_errors[:4], 0.5 * current.gain_errors[:4], rtol=1e-6)
    with pytest.raises(UsageError, match=r"fractions from 0 to 0\.5"):
        identify_payload_samples(result, loaded, gain_uncertainty=7.0)
    with pytest.raises(UsageError, match="one per joint"):
        identify_payload_samples(result, loaded, gain_uncertainty=[0.1, 0.1])


def test_ur10e_weighs_its_known_payload(shared: Path, tmp_path: Path) -> None:
    """True mass 2.805 kg; with the gains in use there the estimate is some 8 % high, which gains
    known to 7 % explain and noise does not.
    """
    sheet = tmp_path / "ur10e.toml"
    sheet.write_text(
        'header = false\ntorque_source = "current"\ngains = [14.87, 13.26, 11.13, 10.62, 11.03,'
        ' 11.47]\n[columns]\ntime = 1\nposition = "2-7"\nvelocity = "8-13"\ntorque = "14-19"\n'
    )
    model = load_robot(shared / "models" / "ur10e.urdf")
    logs = (
        "ur-20_02_10-30sec_12harm.csv",
        "ur-20_02_19_14harm50sec.csv",
        "ur-20_02_19_14harm50secLoad.csv",
    )
    train, bare, loaded = (
        read_recordings([shared / "data" / "ur10e" / log], model=model, sheet=sheet)[0]
        for log in logs
    )
    chain = resolve_chain(SignalChain(), train, bare)
    result = identify_samples(
        model,
        prepare_samples(train, chain),
        drive=DriveSet.parse("armature,viscous,coulomb,offset"),
    )
    payload = identify_payload_samples(
        result, prepare_samples(loaded, chain), unloaded=[prepare_samples(bare, chain)]
    )
    assert abs(payload.values[0] - 2.805) < 2.0 * payload.std_errors[0]
    assert payload.gain_errors[0] > 2.0 * payload.noise_errors[0]
    assert payload.metrics[0].relative_error < 0.3 * payload.metrics_bare[0].relative_error
