"""Proofs that no robot has given base parameters.

Valid on every real robot, violated by these, and as sure as the distance says.
"""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import LinkInertia
from asbuilt.identification import triangular_factor
from asbuilt.identification.bodies.body_bounds import bound_passive_drives
from asbuilt.identification.bodies.conic_fit import ConicProblem
from asbuilt.identification.bodies.consistency import find_inconsistency


def pushed_out(trial, robot, drive, seed):
    """Return a case, base parameters that no robot has, and a covariance with correlations."""
    case = trial(robot, drive, seed=seed, duration=2.0)
    rng = np.random.default_rng(seed)
    beta = case.beta.copy()
    beta[
        [
            case.base.names.index(name)
            for name in case.base.names
            if name.startswith(("Izz2", "Fv1"))
        ]
    ] = -0.4
    spread = rng.normal(size=(len(beta), len(beta))) * 0.02
    return case, beta, spread @ spread.T + 0.01**2 * np.eye(len(beta))


@pytest.mark.parametrize(
    ("robot", "drive"),
    [("two-link", "viscous"), ("ur10e", "viscous,coulomb,offset"), ("scara", "armature,viscous")],
)
def test_no_real_robot_has_the_combination_below_zero(trial, robot, drive):
    case, beta, covariance = pushed_out(trial, robot, drive, 4)
    proof = find_inconsistency(case.base, case.prior, beta, covariance)
    y = np.zeros(len(beta))
    y[[case.base.names.index(name) for name in proof.names]] = proof.coefficients
    assert proof.value == pytest.approx(y @ beta)
    assert proof.value < 0.0
    assert proof.std_error == pytest.approx(np.sqrt(y @ covariance @ y))
    rng = np.random.default_rng(0)
    size = np.abs(case.base.regrouping.T @ y).sum()
    for _ in range(500):
        bodies = [
            LinkInertia.from_com(
                10.0 ** rng.uniform(-2, 1),
                rng.normal(size=3) * 10.0 ** rng.uniform(-2, 0.5),
                np.zeros((3, 3)),
            ).parameters
            for _ in range(case.model.n_joints)
        ]
        drives = np.zeros(case.base.n_standard - 10 * case.model.n_joints)
        passive = case.prior.non_negative - 10 * case.model.n_joints
        drives[passive] = rng.exponential(size=passive.size)
        free = np.setdiff1d(np.arange(drives.size), passive)
        drives[free] = rng.normal(size=free.size)
        chi = np.concatenate([*bodies, drives])
        assert y @ case.base.regrouping @ chi >= -1e-5 * size * np.abs(chi).max()


@pytest.mark.parametrize(
    ("robot", "drive"), [("two-link", "viscous"), ("ur10e", "viscous,coulomb")]
)
def test_sureness_is_the_distance_to_the_nearest_real_robot(trial, robot, drive):
    """The proof's bound and the nearest robot's distance, two programs dual to each other, meet."""
    case, beta, covariance = pushed_out(trial, robot, drive, 5)
    proof = find_inconsistency(case.base, case.prior, beta, covariance)
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    factor = triangular_factor(
        np.vstack([np.column_stack([root, root @ beta]), np.zeros((1, len(beta) + 1))])
    )
    nearest = ConicProblem(
        case.prior, case.base.regrouping, bound_passive_drives(case.prior), smallest_part=0.0
    ).fit(factor, 1e-8)
    distance = np.linalg.norm(root @ (case.base.regrouping @ nearest - beta))
    assert proof.sigmas == pytest.approx(distance, rel=2e-3)
    assert -proof.value / proof.std_error <= proof.sigmas * (1 + 1e-6)


def test_few_parameters_are_named(trial):
    case, beta, covariance = pushed_out(trial, "ur10e", "viscous,coulomb", 6)
    proof = find_inconsistency(case.base, case.prior, beta, covariance)
    assert len(proof.names) <= 5
    assert "standard errors below zero" in proof.sentence
    assert "kg;" not in proof.sentence


def test_nothing_is_said_of_a_robot_that_can_be(trial):
    case = trial("ur10e", "viscous,coulomb", seed=7, duration=2.0)
    assert (
        find_inconsistency(case.base, case.prior, case.beta, 1e-4 * np.eye(len(case.beta))) is None
    )
