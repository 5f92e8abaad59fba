"""The derivatives of the joint torques against Pinocchio, and against differences of inverse
dynamics on trees.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_inertia, random_robot

from asbuilt.description import LinkInertia
from asbuilt.dynamics import inverse_dynamics, mass_matrix
from asbuilt.dynamics.kernels.torque_derivatives import torque_derivatives
from asbuilt.errors import UsageError


def sets_of(rng, count: int, n: int) -> np.ndarray:
    return np.array(
        [np.concatenate([random_inertia(rng).parameters for _ in range(n)]) for _ in range(count)]
    )


@pytest.mark.parametrize("style", ["general", "distal", "proximal"])
@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_derivatives_of_every_set_are_those_of_pinocchio(style: str, n: int) -> None:
    rng = np.random.default_rng(n)
    model, samples = random_robot(rng, n, chain=True, style=style), 37
    q, qd, qdd = rng.normal(size=(3, samples, n))
    sets = sets_of(rng, 3, n)
    found = torque_derivatives(model, q, qd, qdd, sets)
    for place, chi in enumerate(sets):
        links = [
            replace(link, inertia=LinkInertia(own), parts=())
            for link, own in zip(model.links, chi.reshape(n, 10), strict=True)
        ]
        peer = pinocchio_model(replace(model, links=tuple(links)))
        data = peer.createData()
        for s in range(samples):
            by_position, by_velocity, masses = (
                np.array(x) for x in pin.computeRNEADerivatives(peer, data, q[s], qd[s], qdd[s])
            )
            masses = np.triu(masses) + np.triu(masses, 1).T
            expected = np.stack([by_position, by_velocity, masses], axis=2)
            np.testing.assert_allclose(
                found[s, place], expected, rtol=0, atol=1e-11 * max(1.0, np.abs(expected).max())
            )


def test_torques_change_as_the_derivatives_say() -> None:
    rng = np.random.default_rng(11)
    model = random_robot(rng, 8)
    state = rng.normal(size=(3, 70, 8))
    found = torque_derivatives(model, *state)[:, 0]
    for order in range(3):
        for j in range(8):
            step = np.zeros_like(state)
            step[order, :, j] = 1e-5
            slope = (
                inverse_dynamics(model, *(state + step)) - inverse_dynamics(model, *(state - step))
            ) / 2e-5
            np.testing.assert_allclose(
                found[:, :, j, order], slope, rtol=0, atol=1e-7 * max(1.0, np.abs(slope).max())
            )


def test_derivatives_by_acceleration_are_the_mass_matrix_and_sets_do_not_mix() -> None:
    rng = np.random.default_rng(5)
    model = random_robot(rng, 6)
    q, qd, qdd = rng.normal(size=(3, 33, 6))
    sets = sets_of(rng, 4, 6)
    found = torque_derivatives(model, q, qd, qdd, sets)
    for place, chi in enumerate(sets):
        np.testing.assert_allclose(
            found[:, place, :, :, 2], mass_matrix(model, q, parameters=chi), atol=1e-12
        )
        assert np.array_equal(
            torque_derivatives(model, q, qd, qdd, chi[None])[:, 0], found[:, place]
        )


def test_parameters_that_do_not_fit_are_refused() -> None:
    model = random_robot(np.random.default_rng(1), 3)
    rest = np.zeros((2, 3))
    with pytest.raises(UsageError, match=r"\(n_sets, 30\), got \(30,\)"):
        torque_derivatives(model, rest, rest, rest, model.parameters)
