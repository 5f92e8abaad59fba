"""Robots of another engine: two engines agree, and what acts is what the equations say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

from asbuilt.description import load_robot
from asbuilt.excitation import random_fourier
from outside_robot import (
    OutsideRobot,
    dahl,
    mujoco_torque,
    other_bodies,
    pinocchio_torque,
)


def still(name: str) -> OutsideRobot:
    model = load_robot(name)
    return OutsideRobot(model, *np.zeros((4, model.n_joints)))


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "scara", "two-link"])
def test_pinocchio_and_mujoco_agree(name: str) -> None:
    rng = np.random.default_rng(3)
    model = other_bodies(load_robot(name), rng)
    state = rng.uniform(-1.0, 1.0, size=(3, 20, model.n_joints))
    gravity = np.array([0.5, -1.0, -9.7])
    one, two = (torque(model, *state, gravity) for torque in (pinocchio_torque, mujoco_torque))
    np.testing.assert_allclose(one, two, atol=1e-9 * np.abs(one).max())


def test_other_bodies_are_real_and_off_as_said() -> None:
    model = load_robot("kuka-iiwa7-r800")
    ratios = []
    for seed in range(60):
        other = other_bodies(model, np.random.default_rng(seed), mass=0.05)
        assert all(link.inertia.is_consistent for link in other.links)
        ratios += [
            a.inertia.mass / b.inertia.mass for a, b in zip(other.links, model.links, strict=True)
        ]
    assert np.std(ratios) == pytest.approx(0.05, rel=0.15)


def test_bristles_follow_their_differential_equation() -> None:
    length = 0.02
    t = np.linspace(0.0, 3.0, 3001)
    x = 0.1 * np.sin(4.0 * t) + 0.03 * np.sin(11.0 * t)

    def rate(at: float, z: np.ndarray) -> np.ndarray:
        v = 0.4 * np.cos(4.0 * at) + 0.33 * np.cos(11.0 * at)
        return np.asarray((v - abs(v) * z) / length)

    exact = solve_ivp(rate, (0.0, 3.0), [0.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=1e-3)
    np.testing.assert_allclose(dahl(x, length), exact.y[0], atol=2e-3)


def test_a_turned_base_gives_what_a_turned_world_would() -> None:
    """A base turned by +30 deg about x: gravity leans to -y in its frame, `R^T g`."""
    robot = replace(still("ur10e"), turn=np.array([np.pi / 6, 0.0, 0.0]))
    np.testing.assert_allclose(robot.gravity, [0.0, -9.81 * 0.5, -9.81 * np.cos(np.pi / 6)])


def test_a_stiff_spring_makes_the_motor_lead_by_the_load() -> None:
    robot, motion = still("two-link"), random_fourier(load_robot("two-link"), rng=1)
    soft = replace(robot, stiffness={1: 500.0})
    rigid, elastic = robot.logged(motion), soft.logged(motion)
    np.testing.assert_allclose(elastic.q[:, 1] - rigid.q[:, 1], rigid.tau[:, 1] / 500.0)
    np.testing.assert_allclose(elastic.tau, rigid.tau)


def test_a_coupled_motor_keeps_power() -> None:
    """`tau qd` is the power of friction at the motors, whatever they turn with."""
    n = 2
    bare = still("two-link")
    robot = replace(bare, coulomb=np.full(n, 3.0), mix={(1, 0): 0.5})
    motion = random_fourier(load_robot("two-link"), rng=2)
    log, free = robot.logged(motion), bare.logged(motion)
    power = np.sum((log.tau - free.tau) * log.qd, axis=1)
    rates = log.qd @ np.array([[1.0, 0.5], [0.0, 1.0]])
    np.testing.assert_allclose(power, 3.0 * np.abs(rates).sum(axis=1), atol=1e-9)
