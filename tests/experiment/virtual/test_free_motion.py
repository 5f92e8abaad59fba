"""A robot that is let go keeps its energy, or loses what friction takes.

MuJoCo moves it, the equations of asbuilt count.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pinocchio_oracle import random_robot
from scipy.integrate import solve_ivp

from asbuilt.description import (
    DriveValues,
    Joint,
    Link,
    LinkInertia,
    RobotModel,
    bundled_robot,
    robot_names,
)
from asbuilt.dynamics import forward_dynamics
from asbuilt.errors import InertiaError, UsageError
from asbuilt.experiment import run_free
from asbuilt.experiment.virtual.simulation import find_heaviest_pose
from studied_cases import first_of


def with_drives(model: RobotModel, **values: float) -> RobotModel:
    return replace(
        model, joints=tuple(replace(joint, drive=DriveValues(**values)) for joint in model.joints)
    )


@pytest.mark.parametrize("name", first_of(5, robot_names()))
def test_energy_stays_in_free_motion(name: str) -> None:
    model = bundled_robot(name)
    motion = run_free(model, "free", duration=2.0)
    # What closes a loop in MuJoCo is soft, and holds some energy.
    exact = 1e-4 if model.loops else 1e-6
    np.testing.assert_allclose(
        motion.total, motion.total[0], rtol=exact, atol=exact * np.ptp(motion.kinetic)
    )
    assert motion.imbalance < exact
    assert np.ptp(motion.kinetic) > 0.1
    assert not motion.work.any()


@pytest.mark.parametrize("release", ["drop", "step"])
@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "scara"])
def test_energy_balances_with_friction_and_drives(name: str, release: str) -> None:
    model = with_drives(bundled_robot(name), armature=0.5, viscous=3.0, coulomb=2.0, offset=0.3)
    motion = run_free(model, release, duration=2.0)
    assert motion.imbalance < 1e-4
    assert motion.dissipated[-1] > 0.1
    assert (motion.work[-1] == 0.0) == (release == "drop")


def test_heavy_friction_on_light_joints_brakes_a_fall() -> None:
    motion = run_free(
        with_drives(bundled_robot("kuka-iiwa7-r800"), viscous=30.0), "drop", duration=1.0
    )
    assert motion.imbalance < 1e-5
    assert motion.dissipated[-1] > 1.0


def test_a_step_arrives() -> None:
    model = bundled_robot("ur10e")
    motion = run_free(model, "step", duration=3.0)
    np.testing.assert_allclose(np.abs(motion.q[-1] - motion.q[0]), 0.2, atol=1e-3)


def test_free_fall_of_mujoco_is_that_of_scipy_with_our_equations() -> None:
    """Third road: scipy integrates asbuilt's own forward dynamics."""
    model = random_robot(np.random.default_rng(3), 4)
    pose, speed = np.zeros(4), np.array([0.3, -0.2, 0.4, 0.1])
    motion = run_free(model, "free", duration=0.5, start=pose, speed=speed)
    other = solve_ivp(
        lambda _, x: np.r_[x[4:], forward_dynamics(model, x[:4], x[4:], np.zeros(4))],
        (0.0, 0.5),
        np.r_[pose, speed],
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(
        np.r_[motion.q[-1], motion.qd[-1]], other.y[:, -1], rtol=1e-6, atol=1e-7
    )


def test_a_pendulum_swings_as_the_textbook_says() -> None:
    """Small swings of `T = 2 pi sqrt(J / (m g l))`."""
    mass, length = 2.0, 0.4
    bob = LinkInertia.from_com(mass, [0.0, -length, 0.0], np.eye(3) * 1e-3)
    joint = Joint("hinge", "continuous", -1, np.eye(4), np.eye(4))
    pendulum = RobotModel(
        "pendulum", (joint,), (Link("bob", bob),), gravity=np.array([0.0, -9.81, 0.0])
    )
    period = 2 * np.pi * np.sqrt((mass * length**2 + 1e-3) / (mass * 9.81 * length))
    motion = run_free(pendulum, "drop", duration=1.5 * period, start=[1e-3])
    np.testing.assert_allclose(
        motion.q[:, 0], 1e-3 * np.cos(2 * np.pi * motion.t / period), atol=1e-9
    )


def test_bad_releases_are_refused() -> None:
    model = bundled_robot("two-link")
    with pytest.raises(UsageError, match="there is no release 'hop'; there are drop, step, free"):
        run_free(model, "hop")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="start must be 2 finite numbers"):
        run_free(model, start=[0.0])
    with pytest.raises(UsageError, match="duration must be a positive number"):
        run_free(model, duration=-1.0)
    with pytest.raises(InertiaError, match="not positive definite"):
        run_free(model.with_parameters(-model.parameters))
    assert find_heaviest_pose(model).shape == (2,)
