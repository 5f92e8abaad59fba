"""MuJoCo and asbuilt, two engines by different hands, must agree on every torque."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from pinocchio_oracle import random_robot

import mujoco_oracle
from asbuilt.description import LinkInertia, RobotModel, bundled_robot, robot_names
from asbuilt.dynamics import forward_dynamics, inverse_dynamics
from asbuilt.errors import InertiaError, MissingExtraError
from asbuilt.experiment.virtual.physics import Physics


def states(model: RobotModel, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=2.0, size=(3, 40, model.n_joints))


@pytest.mark.parametrize(
    "model",
    [
        *map(bundled_robot, robot_names()),
        *(random_robot(np.random.default_rng(seed), 6) for seed in range(20)),
    ],
    ids=lambda model: model.name,
)
def test_inverse_dynamics_of_mujoco_is_ours_to_nine_digits(model: RobotModel) -> None:
    rng = np.random.default_rng(1)
    armature, viscous = rng.uniform(0.5, 2.0, size=(2, model.n_joints))
    q, qd, qdd = states(model)
    expected = inverse_dynamics(model, q, qd, qdd) + armature * qdd + viscous * qd
    physics = Physics(model, armature=armature, viscous=viscous)
    found = mujoco_oracle.inverse_dynamics(physics, q, qd, qdd)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_inertias_that_no_body_has_are_taken_as_they_are() -> None:
    model = bundled_robot("ur10e")
    rng = np.random.default_rng(3)
    strange = model.with_parameters(
        model.parameters + 0.3 * rng.normal(size=model.parameters.shape)
    )
    assert not all(link.inertia.is_consistent for link in strange.links)
    q, qd, qdd = states(strange)
    expected = inverse_dynamics(strange, q, qd, qdd) + 5.0 * qdd
    found = mujoco_oracle.inverse_dynamics(Physics(strange, armature=5.0), q, qd, qdd)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_accelerations_obey_the_equations_of_motion() -> None:
    model = random_robot(np.random.default_rng(5), 6)
    armature, viscous, coulomb = 0.4, 0.7, 1.3
    physics = Physics(model, armature=armature, viscous=viscous, coulomb=coulomb)
    q, qd, tau = states(model, 4)
    ones = np.ones_like(q)
    qdd, friction = physics.accelerations(
        q, qd, tau, coulomb=coulomb * ones, viscous=viscous * ones
    )
    sliding = np.abs(qd) > 0.002 * np.abs(qdd)
    assert sliding.mean() > 0.9
    np.testing.assert_allclose(
        friction[sliding], (viscous * qd + coulomb * np.sign(qd))[sliding], atol=1e-9
    )
    np.testing.assert_allclose(
        inverse_dynamics(model, q, qd, qdd) + armature * qdd + friction, tau, atol=1e-8
    )
    bare = Physics(model)
    free, none = bare.accelerations(q, qd, tau, coulomb=0 * ones, viscous=0 * ones)
    np.testing.assert_allclose(free, forward_dynamics(model, q, qd, tau), rtol=1e-8, atol=1e-8)
    assert not none.any()


def test_dry_friction_holds_what_it_can_hold() -> None:
    model = bundled_robot("two-link").with_gravity([0.0, 0.0, 0.0])
    physics = Physics(model, coulomb=2.0)
    physics.start([0.0, 0.0], [0.0, 0.0])
    physics.advance(np.array([1.9, -1.9]), 500)
    held = np.abs(physics.state[0]).max()
    physics.start([0.0, 0.0], [0.0, 0.0])
    physics.advance(np.array([2.5, -2.5]), 500)
    assert held < 1e-4
    assert np.abs(physics.state[0]).max() > 0.1


def test_robots_that_no_engine_can_move_are_refused() -> None:
    model = bundled_robot("ur10e")
    massless = replace(
        model, links=(*model.links[:-1], replace(model.links[-1], inertia=LinkInertia.zero()))
    )
    with pytest.raises(
        InertiaError,
        match=(
            r"not positive definite .* mostly joint 'wrist_3_joint'\), so torques .* give the joint"
            r" an armature"
        ),
    ):
        Physics(massless)
    assert Physics(massless, armature=0.1).compiled.nv == 6
    odd = LinkInertia(np.r_[np.zeros(6), 0.1, 0.0, 0.0, 0.0])
    with pytest.raises(
        InertiaError,
        match=r"link 'wrist_3_link' has no mass but the first moment \[0.1, 0.0, 0.0\] kg m",
    ):
        Physics(replace(model, links=(*model.links[:-1], replace(model.links[-1], inertia=odd))))


def test_without_mujoco_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(
        MissingExtraError,
        match=(
            r"a virtual robot needs the package mujoco, which is not installed; run pip install"
            r" \w+, or pip install 'asbuilt\[sim\]'"
        ),
    ):
        Physics(bundled_robot("two-link"))
