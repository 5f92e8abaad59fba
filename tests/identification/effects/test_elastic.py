"""Columns of elastic joints against a simulation of motors and links as two masses."""

from __future__ import annotations

import numpy as np
import pytest
from pinocchio_oracle import pinocchio_model
from scipy.integrate import solve_ivp

from asbuilt.description import RobotModel, load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification.effects.families.elastic import elastic_columns as of_joint

pin = pytest.importorskip("pinocchio")
RATE = 1000.0


def elastic_columns(model: RobotModel, chi: np.ndarray, samples: Samples) -> np.ndarray:
    """Return the columns of all joints, (N, n, n)."""
    state = np.stack([samples.q, samples.qd, samples.qdd])
    joints = range(model.n_joints)
    return np.stack([of_joint(model, chi, state, samples.rate, k) for k in joints], axis=-1)


def as_samples(model: RobotModel, q: np.ndarray, tau: np.ndarray) -> Samples:
    """Return samples of logged motor positions, differentiated."""
    t = np.arange(len(q)) / RATE
    qd = np.gradient(q, t, axis=0, edge_order=2)
    qdd = np.gradient(qd, t, axis=0, edge_order=2)
    return Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names)


def stiff_torque(model: RobotModel, samples: Samples) -> np.ndarray:
    engine = pinocchio_model(model)
    data = engine.createData()
    rows = zip(samples.q, samples.qd, samples.qdd, strict=True)
    return np.array([pin.rnea(engine, data, *row) for row in rows])


def two_masses(model: RobotModel, stiffness: np.ndarray, seconds: float) -> Samples:
    """Simulate links on springs behind motors that move smoothly from rest."""
    engine = pinocchio_model(model)
    data, n = engine.createData(), model.n_joints
    start, frequency = np.array([0.3, -0.8]), np.array([0.7, 1.1])

    def motors(t: float) -> np.ndarray:
        begun = 1.0 - np.exp(-((t / 0.6) ** 4))
        return np.asarray(start + 0.6 * begun * np.sin(2.0 * np.pi * frequency * t))

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        spring = stiffness * (motors(t) - x[:n])
        return np.concatenate([x[n:], pin.aba(engine, data, x[:n], x[n:], spring)])

    rest = start.copy()
    for _ in range(50):
        rest = start - pin.rnea(engine, data, rest, np.zeros(n), np.zeros(n)) / stiffness
    t = np.arange(int(seconds * RATE)) / RATE
    found = solve_ivp(
        rate, (0.0, t[-1]), [*rest, *np.zeros(n)], t_eval=t, method="DOP853", rtol=1e-9, atol=1e-11
    )
    theta = np.array([motors(each) for each in t])
    return as_samples(model, theta, stiffness * (theta - found.y[:n].T))


@pytest.mark.study
def test_columns_explain_a_simulation_of_two_masses() -> None:
    model = load_robot("two-link")
    stiffness = np.array([20000.0, 8000.0])
    samples = two_masses(model, stiffness, 3.0)
    error = samples.tau - stiff_torque(model, samples)
    columns = elastic_columns(model, model.parameters, samples)
    inside = slice(20, -20)
    explained = columns[inside] @ (1.0 / stiffness)
    left = np.linalg.norm(error[inside] - explained) / np.linalg.norm(error[inside])
    assert left < 0.1
    flat = columns[inside].reshape(-1, 2)
    compliance = np.linalg.lstsq(flat, error[inside].ravel(), rcond=None)[0]
    np.testing.assert_allclose(1.0 / compliance, stiffness, rtol=0.05)


@pytest.mark.parametrize("name", ["ur10e", "scara"])
def test_what_is_left_is_of_second_order(name: str) -> None:
    """Half the compliance leaves a quarter of the error, for every joint and kind of joint."""
    model = load_robot(name)
    engine = pinocchio_model(model)
    data = engine.createData()
    move = random_fourier(model, rng=4, duration=4.0, n_harmonics=4).sample(RATE)
    states = zip(move.q, move.qd, move.qdd, strict=True)
    load = np.array([pin.rnea(engine, data, *state) for state in states])
    compliance = 5e-3 / np.abs(load).max(axis=0)
    inside = slice(50, -50)
    left = []
    for share in (1.0, 0.5):
        samples = as_samples(model, move.q + share * compliance * load, load)
        columns = elastic_columns(model, model.parameters, samples)
        error = load - stiff_torque(model, samples) - columns @ (share * compliance)
        left.append(np.linalg.norm(error[inside], axis=0))
        felt = np.linalg.norm((columns @ (share * compliance))[inside], axis=0)
        assert np.all(left[-1] < 0.2 * felt)
    np.testing.assert_allclose(left[1] / left[0], 0.25, atol=0.03)
