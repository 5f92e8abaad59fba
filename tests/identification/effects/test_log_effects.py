"""Errors put into the logs of virtual robots are named with their size, and no others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, bundled_robot
from asbuilt.dynamics import DriveSet, inverse_dynamics
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, VirtualRobot, prepare_samples
from asbuilt.findings import Finding
from asbuilt.identification import FoundEffect, find_effects
from asbuilt.identification.effects.effect_findings import report_effects
from asbuilt.identification.effects.plateaus import (
    drop_plateaus,
    find_plateaus,
    report_plateaus,
)

DRIVE = DriveSet.parse("viscous,coulomb,offset")
Fault = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


def logged(model: RobotModel, fault: Fault | None = None, seed: int = 1) -> Recording:
    """Return a log of a robot as described, noise 1 % of the torque, with a fault of the log."""
    machine = VirtualRobot.ideal(model).with_drive(DRIVE, np.tile([1.0, 2.0, 0.3], model.n_joints))
    motion = random_fourier(model, rng=seed, duration=30.0)
    log = machine.record(motion, rate=100.0).recording
    t, q, tau = (np.array(x) for x in (log.t, log.q, log.tau))
    level = 0.01 * np.sqrt(np.mean(tau**2, axis=0))
    if fault is not None:
        t, q, tau = fault(t, q, tau)
    noise = level * np.random.default_rng(seed).normal(size=tau.shape)
    return replace(log, t=t, q=q, tau=tau + noise, qd=None, qdd=None)


def found(name: str, fault: Fault | None = None, tilt: float = 0.0) -> tuple[FoundEffect, ...]:
    """Return the effects found in the log of a robot whose base is tilted by so much [rad]."""
    model = bundled_robot(name)
    turned = Rotation.from_rotvec([tilt, -0.6 * tilt, 0.0])
    real = model.with_gravity(turned.apply(np.array(model.gravity)))
    return find_effects(model, DRIVE, [prepare_samples(logged(real, fault))]).found


def slow_clock(factor: float) -> Fault:
    return lambda t, q, tau: (factor * t, q, tau)


def zero_off(joint: int, by: float) -> Fault:
    return lambda t, q, tau: (t, q + by * np.eye(q.shape[1])[joint], tau)


def gain(joint: int, factor: float) -> Fault:
    return lambda t, q, tau: (t, q, tau * (1.0 + (factor - 1.0) * np.eye(q.shape[1])[joint]))


def saturating(joint: int, part: float) -> Fault:
    def fault(t: Array, q: Array, tau: Array) -> tuple[Array, Array, Array]:
        limit = part * np.abs(tau[:, joint]).max()
        held = tau.copy()
        held[:, joint] = np.clip(tau[:, joint], -limit, limit)
        return t, q, held

    return fault


def drifting(joint: int, by: float) -> Fault:
    return lambda t, q, tau: (
        t,
        q,
        tau + by * np.outer(t / t[-1], np.eye(q.shape[1])[joint]),
    )


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(name, marks=pytest.mark.study) for name in ("ur10e", "franka-panda")), "scara"],
)
def test_a_right_log_has_no_errors(name: str) -> None:
    assert found(name) == ()


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("ur10e", 1.05),
        pytest.param("ur10e", 0.5, marks=pytest.mark.study),
        pytest.param("franka-panda", 2.0, marks=pytest.mark.study),
        pytest.param("kuka-iiwa7-r800", 10.0, marks=pytest.mark.study),
    ],
)
def test_a_wrong_clock_is_measured(name: str, factor: float) -> None:
    (error,) = found(name, slow_clock(factor))
    assert (error.effect, error.joint) == ("clock", None)
    assert error.estimate + 1.0 == pytest.approx(factor, abs=max(5.0 * error.std_error, 1e-3))
    assert error.std_error < 0.01 * factor


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "joint", "by"),
    [("ur10e", 3, -0.05), pytest.param("franka-panda", 3, 0.035, marks=pytest.mark.study)],
)
def test_a_wrong_zero_position_is_measured(name: str, joint: int, by: float) -> None:
    error = found(name, zero_off(joint, by))[0]
    assert (error.effect, error.joint) == ("zero", bundled_robot(name).joint_names[joint])
    assert error.estimate == pytest.approx(by, abs=4.0 * error.std_error)
    assert error.std_error < 0.2 * abs(by)


@pytest.mark.parametrize(
    ("name", "joint", "factor"),
    [("ur10e", 1, 0.9), pytest.param("franka-panda", 3, 1.15, marks=pytest.mark.study)],
)
def test_a_wrong_gain_is_measured(name: str, joint: int, factor: float) -> None:
    error = found(name, gain(joint, factor))[0]
    assert (error.effect, error.joint) == ("gain", bundled_robot(name).joint_names[joint])
    assert 1.0 + error.estimate == pytest.approx(factor, abs=4.0 * error.std_error)


@pytest.mark.parametrize(
    ("name", "joint", "tilt"),
    [("franka-panda", 1, 0.03), ("ur10e", 1, 0.2)],
)
@pytest.mark.study
def test_gains_are_sought_on_the_tilted_robot(name: str, joint: int, tilt: float) -> None:
    (turned,) = found(name, tilt=tilt)
    assert turned.effect == "tilt"
    turned, error = found(name, gain(joint, 0.9), tilt)
    assert turned.effect == "tilt"
    assert (error.effect, error.joint) == ("gain", bundled_robot(name).joint_names[joint])
    assert 1.0 + error.estimate == pytest.approx(0.9, abs=3e-3)


@pytest.mark.study
def test_a_dead_sensor_is_named() -> None:
    model = bundled_robot("ur10e")
    codes = findings("ur10e", logged(model, gain(2, 0.0)))
    assert codes["torque_does_not_follow"].joint == model.joint_names[2]


@pytest.mark.parametrize(("name", "joint"), [("ur10e", 1)])
def test_a_saturated_torque_is_named(name: str, joint: int) -> None:
    errors = found(name, saturating(joint, 0.6))
    assert ("saturation", bundled_robot(name).joint_names[joint]) in [
        (each.effect, each.joint) for each in errors
    ]


def findings(name: str, recording: Recording) -> dict[str, Finding]:
    """Return the findings of a log by their codes."""
    model, samples = bundled_robot(name), [prepare_samples(recording)]
    flat = find_plateaus(model, DRIVE, samples)
    effects = find_effects(model, DRIVE, drop_plateaus(samples, flat))
    effects = effects.beside_plateaus({model.joint_names[each.joint] for each in flat})
    said = (*report_plateaus(model, flat), *report_effects(effects))
    return {each.code: each for each in said}


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "joint", "part"),
    [
        ("ur10e", 1, 0.7),
        pytest.param("franka-panda", 3, 0.85, marks=pytest.mark.study),
        pytest.param("kuka-iiwa7-r800", 3, 0.5, marks=pytest.mark.study),
        pytest.param("puma-560", 2, 0.7, marks=pytest.mark.study),
    ],
)
def test_a_plateau_of_the_torque_is_named_with_its_level(
    name: str, joint: int, part: float
) -> None:
    """Thresholds were settled on the other robots, none on the Puma."""
    model = bundled_robot(name)
    limit = part * np.abs(logged(model).tau[:, joint]).max()
    found = findings(name, logged(model, saturating(joint, part)))
    assert {code for code in found if not code.endswith("_unseen")} == {"torque_saturates"}
    assert found["torque_saturates"].joint == model.joint_names[joint]
    said = found["torque_saturates"].message.split("stays at ")[1].split()[0]
    assert abs(float(said)) == pytest.approx(limit, rel=0.03)


def test_friction_at_constant_speed_is_no_saturation() -> None:
    model = bundled_robot("ur10e")
    motion = random_fourier(model, rng=1, duration=30.0).sample(100.0)
    q = 0.2 * motion.q
    q[:, 0] = np.arcsin(0.95 * np.sin(0.4 * motion.t))
    qd = np.gradient(q, motion.t, axis=0)
    tau = inverse_dynamics(model, q, qd, np.gradient(qd, motion.t, axis=0))
    tau += np.array([100.0, 5, 5, 2, 2, 2]) * np.tanh(qd / 0.01)
    tau += np.random.default_rng(1).normal(scale=0.2, size=tau.shape)
    samples = prepare_samples(Recording(t=motion.t, q=q, tau=tau, joint_names=model.joint_names))
    near = np.abs(samples.tau[:, 0]) > 0.95 * np.percentile(np.abs(samples.tau[:, 0]), 99.5)
    assert np.mean(near) > 0.3
    assert find_plateaus(model, DRIVE, [samples]) == ()


@pytest.mark.parametrize(
    ("name", "unseen"),
    [pytest.param("ur10e", False, marks=pytest.mark.study), ("scara", True)],
)
def test_a_log_that_shows_no_error_of_the_clock_says_so(name: str, unseen: bool) -> None:
    found = findings(name, logged(bundled_robot(name)))
    assert {code for code in found if not code.endswith("_unseen")} == set()
    assert ("clock_unseen" in found) == unseen
    if unseen:
        assert "of any size" in found["clock_unseen"].message


@pytest.mark.study
def test_errors_beyond_the_size_that_shows_are_found_and_smaller_ones_are_not() -> None:
    model, joint = bundled_robot("ur10e"), 3
    unseen = find_effects(model, DRIVE, [prepare_samples(logged(model))]).unseen
    zero, share = unseen["zero", joint], unseen["gain", joint]
    assert 0.0 < zero < 0.05
    assert 0.0 < share < 0.2
    for size, named in ((2.0, True), (0.4, False)):
        for kind, fault in (
            ("zero", zero_off(joint, size * zero)),
            ("gain", gain(joint, 1.0 - size * share)),
        ):
            errors = [(each.effect, each.joint) for each in found("ur10e", fault)]
            assert ((kind, model.joint_names[joint]) in errors) == named, (kind, size)


@pytest.mark.study
def test_a_drifting_sensor_is_measured() -> None:
    (error,) = found("ur10e", drifting(1, 8.0))
    assert (error.effect, error.joint) == ("drift", "shoulder_lift_joint")
    assert error.estimate == pytest.approx(8.0, abs=4.0 * error.std_error)


@pytest.mark.parametrize(("viscous", "coulomb"), [(0.5, 0.0), (0.3, 0.6)])
def test_friction_that_falls_is_measured(viscous: float, coulomb: float) -> None:
    """Viscous friction of 1 N m s/rad alone, or all friction by 30 % of what it is.

    The share is of friction that was estimated without it, which moves by a tenth.
    """

    def warming(t: Array, q: Array, tau: Array) -> tuple[Array, Array, Array]:
        speed = np.gradient(q[:, 4], t)
        lost = viscous * speed + coulomb * np.sign(speed)
        return t, q, tau - np.outer(lost * t / t[-1], np.eye(q.shape[1])[4])

    (effect,) = found("ur10e", warming)
    assert (effect.effect, effect.joint) == ("warming", "wrist_2_joint")
    of_the_middle = -viscous / (1.0 - 0.5 * viscous)
    assert effect.estimate == pytest.approx(of_the_middle, rel=0.1)


@pytest.mark.study
def test_the_cure_of_a_zero_position_is_a_field_of_a_sheet() -> None:
    said = findings("ur10e", logged(bundled_robot("ur10e"), zero_off(1, 0.035)))
    finding = said["zero_position_wrong"]
    assert {code for code in said if not code.endswith("_unseen")} == {"zero_position_wrong"}
    assert "deg too large" in finding.message
    assert "zero = [0, 0.03" in str(finding.cure)
