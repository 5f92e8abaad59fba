"""The equations of motion against Pinocchio, identities between them, and the balance of energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_inertia, random_robot
from scipy.integrate import solve_ivp

from asbuilt.description import RobotModel
from asbuilt.dynamics import (
    coriolis_matrix,
    coriolis_torque,
    forward_dynamics,
    gravity_torque,
    inverse_dynamics,
    kinetic_energy,
    mass_matrix,
    potential_energy,
)
from asbuilt.dynamics.kernels.recursion import BLOCK
from asbuilt.errors import InertiaError, UsageError

CASES = [(style, n) for style in ("general", "distal", "proximal") for n in (1, 2, 7, 12)]


def drawn(
    seed: int, n: int, style: str = "general", samples: int = 9
) -> tuple[RobotModel, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, qd, qdd = rng.normal(scale=2.0, size=(3, samples, n))
    return random_robot(rng, n, style=style), q, qd, qdd


def assert_close(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.shape == np.shape(expected)
    np.testing.assert_allclose(
        found, expected, rtol=0, atol=1e-12 * max(1.0, float(np.abs(expected).max()))
    )


@pytest.mark.parametrize(("style", "n"), CASES)
def test_inverse_dynamics_is_that_of_pinocchio(style, n):
    model, q, qd, qdd = drawn(n, n, style)
    peer = pinocchio_model(model)
    data = peer.createData()
    assert_close(
        inverse_dynamics(model, q, qd, qdd),
        np.array([pin.rnea(peer, data, *state) for state in zip(q, qd, qdd, strict=True)]),
    )
    assert_close(
        gravity_torque(model, q),
        np.array([pin.computeGeneralizedGravity(peer, data, sample) for sample in q]),
    )


@pytest.mark.parametrize(("style", "n"), CASES)
def test_mass_matrix_is_the_torque_of_unit_accelerations_in_pinocchio(style, n):
    model, q, _, _ = drawn(n, n, style)
    weightless = pinocchio_model(model.with_gravity(np.zeros(3)))
    data, rest = weightless.createData(), np.zeros(n)
    columns = [
        [pin.rnea(weightless, data, sample, rest, unit) for unit in np.eye(n)] for sample in q
    ]
    masses = mass_matrix(model, q)
    assert_close(masses, np.array(columns))
    np.testing.assert_array_equal(masses, np.swapaxes(masses, 1, 2))


def test_mass_matrix_of_a_chain_is_that_of_composite_bodies():
    rng = np.random.default_rng(5)
    model, q = random_robot(rng, 7, chain=True), rng.normal(size=(4, 7))
    peer = pinocchio_model(model)
    upper = [np.triu(pin.crba(peer, peer.createData(), sample)) for sample in q]
    assert_close(mass_matrix(model, q), np.array([half + np.triu(half, 1).T for half in upper]))


@pytest.mark.parametrize("seed", range(5))
def test_torque_is_the_sum_of_its_parts(seed):
    model, q, qd, qdd = drawn(seed, 6)
    inertial = np.einsum("sij,sj->si", mass_matrix(model, q), qdd)
    assert_close(
        inertial + coriolis_torque(model, q, qd) + gravity_torque(model, q),
        inverse_dynamics(model, q, qd, qdd),
    )


@pytest.mark.parametrize("seed", range(5))
def test_coriolis_matrix_gives_the_torque_and_is_half_the_mass_rate_but_for_a_skew_part(seed):
    model, q, qd, _ = drawn(seed, 6)
    factor, step = coriolis_matrix(model, q, qd), 1e-5
    assert_close(np.einsum("sij,sj->si", factor, qd), coriolis_torque(model, q, qd))
    mass_rate = (mass_matrix(model, q + step * qd) - mass_matrix(model, q - step * qd)) / (2 * step)
    np.testing.assert_allclose(
        factor + np.swapaxes(factor, 1, 2), mass_rate, rtol=0, atol=1e-7 * np.abs(mass_rate).max()
    )


@pytest.mark.parametrize("seed", range(5))
def test_forward_dynamics_undoes_inverse_dynamics(seed):
    model, q, qd, qdd = drawn(seed, 7)
    found = forward_dynamics(model, q, qd, inverse_dynamics(model, q, qd, qdd))
    np.testing.assert_allclose(found, qdd, rtol=0, atol=1e-10)
    peer = pinocchio_model(model)
    np.testing.assert_allclose(
        forward_dynamics(model, q[0], qd[0], qdd[0]),
        pin.aba(peer, peer.createData(), q[0], qd[0], qdd[0]),
        rtol=1e-9,
    )


def test_energies_are_those_of_pinocchio():
    model, q, qd, _ = drawn(3, 7)
    peer = pinocchio_model(model)
    data = peer.createData()
    assert_close(
        kinetic_energy(model, q, qd),
        np.array(
            [pin.computeKineticEnergy(peer, data, *state) for state in zip(q, qd, strict=True)]
        ),
    )
    assert_close(
        potential_energy(model, q),
        np.array([pin.computePotentialEnergy(peer, data, sample) for sample in q]),
    )
    assert kinetic_energy(model, q[0], qd[0]).shape == ()


@pytest.mark.parametrize("seed", range(3))
def test_power_of_the_drives_is_the_rate_of_energy(seed):
    model, _, _, _ = drawn(seed, 4)
    amplitude, phase = np.random.default_rng(seed).normal(size=(2, 4))

    def moving(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angle = t[:, None] * 2 + phase
        return (
            amplitude * np.sin(angle),
            2 * amplitude * np.cos(angle),
            -4 * amplitude * np.sin(angle),
        )

    nodes, weights = np.polynomial.legendre.leggauss(48)
    t = 0.75 * (nodes + 1)
    q, qd, qdd = moving(t)
    work = 0.75 * weights @ np.sum(inverse_dynamics(model, q, qd, qdd) * qd, axis=1)
    q, qd, _ = moving(np.array([0.0, 1.5]))
    energy = kinetic_energy(model, q, qd) + potential_energy(model, q)
    assert work == pytest.approx(energy[1] - energy[0], rel=1e-11, abs=1e-11)


def test_a_falling_arm_keeps_its_energy():
    model = random_robot(np.random.default_rng(11), 3, chain=True)
    model = replace(model, joints=tuple(replace(joint, kind="revolute") for joint in model.joints))

    def rate(_t: float, state: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [state[3:], forward_dynamics(model, state[:3], state[3:], np.zeros(3))]
        )

    path = solve_ivp(rate, (0.0, 0.5), np.zeros(6), rtol=1e-10, atol=1e-11).y.T
    energy = kinetic_energy(model, path[:, :3], path[:, 3:]) + potential_energy(model, path[:, :3])
    assert np.abs(path[-1]).max() > 0.1
    np.testing.assert_allclose(
        energy, energy[0], rtol=0, atol=1e-7 * kinetic_energy(model, path[:, :3], path[:, 3:]).max()
    )


@pytest.mark.parametrize("samples", [0, 1, 7, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK])
def test_every_number_of_samples_gives_what_one_gives(samples):
    model, q, qd, qdd = drawn(1, 5, samples=samples)
    torques, masses = inverse_dynamics(model, q, qd, qdd), mass_matrix(model, q)
    assert torques.shape == (samples, 5)
    assert masses.shape == (samples, 5, 5)
    for s in range(samples):
        row = slice(s, s + 1)
        np.testing.assert_array_equal(
            torques[row], inverse_dynamics(model, q[row], qd[row], qdd[row])
        )
        np.testing.assert_array_equal(masses[row], mass_matrix(model, q[row]))
        assert_close(inverse_dynamics(model, q[s], qd[s], qdd[s]), torques[s])
        assert_close(mass_matrix(model, q[s]), masses[s])


@pytest.mark.parametrize("threads", [2, 3, 64, None])
def test_threads_do_not_change_a_bit(threads):
    model, q, qd, qdd = drawn(2, 4, samples=20011)
    np.testing.assert_array_equal(
        inverse_dynamics(model, q, qd, qdd, threads=threads),
        inverse_dynamics(model, q, qd, qdd, threads=1),
    )


def test_layout_of_the_arrays_in_memory_does_not_matter():
    model, q, qd, qdd = drawn(2, 4)
    expected = inverse_dynamics(model, q, qd, qdd)
    q.setflags(write=False)
    np.testing.assert_array_equal(
        inverse_dynamics(model, q, np.asfortranarray(qd), qdd.tolist()), expected
    )


def test_parameters_replace_those_of_the_model():
    model, q, qd, qdd = drawn(4, 3)
    assert_close(
        inverse_dynamics(model, q, qd, qdd, parameters=2 * model.parameters),
        2 * inverse_dynamics(model, q, qd, qdd),
    )
    with pytest.raises(UsageError, match="30 inertial parameters, got shape"):
        inverse_dynamics(model, q, qd, qdd, parameters=np.zeros(31))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda q: q[:, :2], r"q must have shape \(3,\) or \(n_samples, 3\).*got \(9, 2\)"),
        (lambda q: q[:4], r"shapes differ: q \(4, 3\), qd \(9, 3\)"),
        (
            lambda q: np.where(np.arange(27).reshape(9, 3) == 16, np.nan, q),
            r"q of joint 'joint2' is nan at sample 5",
        ),
        (lambda q: q[None], r"got \(1, 9, 3\)"),
    ],
)
def test_wrong_inputs_are_named_at_the_door(spoil, said):
    model, q, qd, qdd = drawn(0, 3)
    with pytest.raises(UsageError, match=said):
        inverse_dynamics(model, spoil(q), qd, qdd)


def test_other_parameters_are_those_of_another_robot():
    model, q, qd, qdd = drawn(1, 4)
    chi = np.concatenate([random_inertia(np.random.default_rng(2)).parameters for _ in range(4)])
    other = model.with_parameters(chi)
    states = {
        inverse_dynamics: (q, qd, qdd),
        gravity_torque: (q,),
        coriolis_torque: (q, qd),
        mass_matrix: (q,),
        coriolis_matrix: (q, qd),
        forward_dynamics: (q, qd, qdd),
        kinetic_energy: (q, qd),
        potential_energy: (q,),
    }
    for function, state in states.items():
        np.testing.assert_array_equal(
            function(model, *state, parameters=chi),
            function(other, *state),
            err_msg=function.__name__,
        )
        with pytest.raises(UsageError, match=r"has 40 inertial parameters, got shape \(39,\)"):
            function(model, *state, parameters=chi[:39])


def test_threads_must_be_positive():
    model, q, qd, qdd = drawn(0, 3)
    with pytest.raises(UsageError, match="threads must be at least 1, got 0"):
        inverse_dynamics(model, q, qd, qdd, threads=0)


def test_a_massless_robot_has_no_acceleration():
    model, q, qd, _ = drawn(0, 3)
    with pytest.raises(InertiaError, match="not positive definite: smallest eigenvalue"):
        forward_dynamics(model.with_parameters(np.zeros(30)), q, qd, q)
