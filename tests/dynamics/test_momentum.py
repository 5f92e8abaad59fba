"""Generalised momentum against the matrices and against differences of kinetic energy."""

import numpy as np
import pytest
from reload_oracle import two_armed

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.dynamics import apply_lag, coriolis_matrix, kinetic_energy, mass_matrix
from asbuilt.dynamics.momentum import Momentum
from example_identification import example_robot

ROBOTS = (bundled_robot("kuka-iiwa7-r800"), example_robot("slides"), two_armed())


@pytest.mark.parametrize("model", ROBOTS, ids=lambda model: model.name)
def test_momentum_is_mass_matrix_times_velocity(model: RobotModel) -> None:
    q, qd = np.random.default_rng(0).normal(size=(2, 20, model.n_joints))
    p, gradient = Momentum(model, model.parameters.reshape(-1, 10))(q, qd)
    M, C = mass_matrix(model, q), coriolis_matrix(model, q, qd)
    assert np.allclose(p, np.einsum("sij,sj->si", M, qd), rtol=0, atol=1e-12 * np.abs(p).max())
    expected = np.einsum("sji,sj->si", C, qd)
    assert np.allclose(gradient, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("model", ROBOTS, ids=lambda model: model.name)
def test_gradient_is_that_of_kinetic_energy(model: RobotModel) -> None:
    q, qd = np.random.default_rng(1).normal(size=(2, model.n_joints))
    step = 1e-6
    slopes = [
        float(
            kinetic_energy(model, q + step * unit, qd) - kinetic_energy(model, q - step * unit, qd)
        )
        / (2 * step)
        for unit in np.eye(model.n_joints)
    ]
    gradient = Momentum(model, model.parameters.reshape(-1, 10))(q[None], qd[None])[1][0]
    assert np.allclose(gradient, slopes, rtol=0, atol=1e-7 * max(1.0, np.abs(slopes).max()))


def test_lag_is_exact_for_steps() -> None:
    """A step of 1 gives 1 - exp(-K t) on any clock, and a negative share starts anew."""
    steps = np.random.default_rng(2).uniform(0.001, 0.05, 50)
    share = -np.expm1(-20.0 * steps)
    y = apply_lag(share, np.ones((50, 1)))[:, 0]
    assert np.allclose(y, 1.0 - np.exp(-20.0 * np.cumsum(steps)), rtol=1e-12)
    share[30] = -1.0
    assert apply_lag(share, np.ones((50, 1)))[30, 0] == 0.0
