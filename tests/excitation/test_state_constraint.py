"""Torque and power as constraints.

Values against inverse dynamics of every description, derivatives against differences.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import described_drive, drive_torque, inverse_dynamics
from asbuilt.excitation.state_constraint import PowerLimit, TorqueLimit, perturb_models


def rough(model):
    """The robot with friction that depends on velocity, load and position."""
    joints = [
        replace(
            joint,
            drive=replace(
                joint.drive,
                viscous=3.0 + k,
                coulomb=4.0,
                terms={"load_friction": {"Fl": 0.05 + 0.01 * k}, "spring": {"Ks": 2.0 + k}},
            ),
        )
        for k, joint in enumerate(model.joints)
    ]
    return replace(model, joints=tuple(joints))


def unlike(model):
    """The robot with friction whose shape differs from joint to joint, and one joint without."""
    joints = [
        replace(
            joint,
            drive=replace(
                joint.drive,
                terms=(
                    {"stribeck": {"Fs": 5.0, "velocity": 0.3 + 0.1 * k, "power": 2.0}} if k else {}
                ),
            ),
        )
        for k, joint in enumerate(model.joints)
    ]
    return replace(model, joints=tuple(joints))


def states(n: int, samples: int = 41):
    return tuple(np.random.default_rng(3).uniform(-1.5, 1.5, (3, samples, n)))


def differences(constraint, state, step: float = 1e-5) -> np.ndarray:
    found = np.zeros((*constraint.values(*state).shape, state[0].shape[1], 3))
    for order in range(3):
        for j in range(state[0].shape[1]):
            way = np.zeros((3, 1, state[0].shape[1]))
            way[order, 0, j] = step
            up, down = ([x + sign * w for x, w in zip(state, way, strict=True)] for sign in (1, -1))
            found[:, :, j, order] = (constraint.values(*up) - constraint.values(*down)) / (2 * step)
    return found


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "scara"])
def test_values_are_the_torques_of_every_description(name: str) -> None:
    model = load_robot(name)
    models = perturb_models(model, 3, 0.2, np.random.default_rng(1))
    limit = np.linspace(20.0, 80.0, model.n_joints)
    limit[1] = np.inf
    state, kept = states(model.n_joints), np.flatnonzero(np.isfinite(limit))
    found = TorqueLimit(models, limit).values(*state).reshape(-1, 4, kept.size)
    for place, other in enumerate(models):
        np.testing.assert_allclose(
            found[:, place], (inverse_dynamics(other, *state) / limit)[:, kept], rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("make", [rough, unlike])
def test_friction_is_that_of_the_description_away_from_standstill(make) -> None:
    model, limit = make(load_robot("ur10e")), np.full(6, 50.0)
    state = states(6)
    state[1][np.abs(state[1]) < 0.3] = 0.3
    rigid = inverse_dynamics(model, *state)
    drive, values = described_drive(model)
    expected = rigid + drive_torque(drive, values, *state, load=rigid)
    np.testing.assert_allclose(
        TorqueLimit((model,), limit).values(*state), expected / limit, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("make", [lambda model: model, rough, unlike])
@pytest.mark.parametrize("others", [0, 3])
def test_slopes_of_torque_and_power_are_differences_of_the_values(make, others: int) -> None:
    model = make(load_robot("ur10e"))
    limit = np.array([300.0, 250.0, 100.0, np.inf, 30.0, 20.0])
    state = states(6)
    state[1][np.abs(state[1]) < 0.1] = 0.1
    constraints = [
        TorqueLimit(perturb_models(model, others, 0.2, np.random.default_rng(2)), limit),
        PowerLimit(model, limit),
    ]
    for constraint in constraints:
        expected = differences(constraint, state)
        np.testing.assert_allclose(
            constraint.slopes(*state), expected, rtol=0, atol=2e-6 * np.abs(expected).max()
        )


def test_friction_of_motors_that_several_joints_turn_counts() -> None:
    """A motor that turns with two joints drags both by `T^T Fvm (T qd)`."""
    model = load_robot("ur10e")
    coupling = np.eye(6)
    coupling[4, 3] = 0.5
    joints = [
        replace(
            joint,
            drive=replace(joint.drive, terms={"motor_viscous": {"Fvm": 2.0}} if k == 4 else {}),
        )
        for k, joint in enumerate(model.joints)
    ]
    model = replace(model, joints=tuple(joints), motor_coupling=coupling)
    state, limit = states(6), np.full(6, 50.0)
    constraint = TorqueLimit((model,), limit)
    expected = inverse_dynamics(model, *state) + 2.0 * np.outer(state[1] @ coupling[4], coupling[4])
    np.testing.assert_allclose(constraint.values(*state), expected / limit, rtol=0, atol=1e-12)
    slopes = differences(constraint, state)
    np.testing.assert_allclose(
        constraint.slopes(*state), slopes, rtol=0, atol=2e-6 * np.abs(slopes).max()
    )
