"""The entropic fit against derivatives by differences, a descent in other coordinates, and an independent modelling of the same program."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from asbuilt.description.inertia import LinkInertia, pseudo_inertias
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.body_bounds import non_negative_drives
from asbuilt.identification.entropic_fit import Coordinates, _Problem, closest_to_cad


def factor_of(trial):
    noise = np.sqrt(trial.information.torque_energy / trial.information.n_samples) * 0.05
    return trial.information.stacked(1.0 / noise)


def inside(prior):
    chi = prior.parameters.copy()
    chi[prior.non_negative] = np.maximum(chi[prior.non_negative], 0.1)
    return chi


def objective(trial, factor, chi, weight):
    error = factor[:-1, :-1] @ (trial.base.regrouping @ chi) - factor[:-1, -1]
    return 0.5 * error @ error + weight * trial.prior.strength @ trial.prior.divergence(chi)


@pytest.mark.parametrize("robot", ["two-link", "scara", "puma-560", "kuka-iiwa7-r800"])
def test_gradient_and_hessian_by_differences(trial, around_cad, robot):
    case = trial(robot, noise=0.1, seed=1, duration=6.0)
    rng = np.random.default_rng(0)
    chi = around_cad(case.prior, rng, 0.1)
    for factor in (None, 1e-2 * factor_of(case)):
        problem = _Problem(case.prior, Coordinates.of(case.base), 3.0, factor, non_negative_drives(case.prior))
        gradient, root = problem.model(chi, 0.1)
        for _ in range(4):
            step = rng.normal(size=len(gradient))
            room = problem.room(chi, problem.directions @ step)
            step *= 1e-4 * min(1.0, room)
            ahead, behind = (problem.model(chi + sign * problem.directions @ step, 0.1)[0] for sign in (1.0, -1.0))
            up, down = (problem.value(chi + sign * problem.directions @ step, 0.1) for sign in (1.0, -1.0))
            scale = np.linalg.norm(root @ step)
            assert (up - down) / 2 == pytest.approx(gradient @ step, abs=1e-5 * scale**2 + 1e-9 * abs(up))
            np.testing.assert_allclose(
                (ahead - behind) / 2, root.T @ (root @ step), rtol=1e-5, atol=1e-5 * np.abs(root.T @ root @ step).max()
            )


@pytest.mark.parametrize("robot", ["two-link", "scara"])
@pytest.mark.parametrize("weight", [1.0, 30.0])
def test_same_minimum_as_a_descent_in_log_cholesky_coordinates(trial, robot, weight):
    """Rucker & Wensing (2022): any ten numbers per link are a real body, so a general minimiser needs no constraints."""
    case = trial(robot, "none", noise=0.5, seed=2, duration=5.0, spread=0.3)
    factor = factor_of(case)
    fit = closest_to_cad(case.prior, Coordinates.of(case.base), inside(case.prior), weight=weight, factor=factor)
    n = case.prior.n_links

    def bodies(theta):
        return np.concatenate([LinkInertia.from_log_cholesky(row).parameters for row in theta.reshape(n, 10)])

    start = np.concatenate([LinkInertia(body).log_cholesky for body in case.prior.parameters.reshape(n, 10)])
    found = minimize(
        lambda theta: objective(case, factor, bodies(theta), weight), start, method="BFGS", options={"maxiter": 3000, "gtol": 1e-4}
    )
    assert objective(case, factor, fit.chi, weight) <= found.fun * (1 + 1e-9)
    assert objective(case, factor, fit.chi, weight) == pytest.approx(found.fun, rel=1e-3)


def test_same_minimum_as_an_independent_conic_program(trial):
    cp = pytest.importorskip("cvxpy")
    case = trial("two-link", "viscous,coulomb", noise=0.5, seed=4, duration=4.0)
    factor = 0.1 * factor_of(case)
    weight = 2.0
    limits = non_negative_drives(case.prior)
    fit = closest_to_cad(
        case.prior, Coordinates.of(case.base), inside(case.prior), weight=weight, factor=factor, bounds=limits, barrier=1e-8
    )
    chi, basis = cp.Variable(case.base.n_standard), pseudo_inertias(np.eye(10))
    cost = 0.5 * cp.sum_squares(factor[:-1, :-1] @ case.base.regrouping @ chi - factor[:-1, -1])
    for i, P0 in enumerate(case.prior.pseudo_inertias):
        inverse = np.linalg.inv(np.linalg.cholesky(P0))
        whitened = sum(chi[10 * i + a] * (inverse @ basis[a] @ inverse.T) for a in range(10))
        cost += weight * (cp.trace(whitened) - cp.log_det(whitened) - 4)
    problem = cp.Problem(cp.Minimize(cost), [chi[20:] >= 0])
    problem.solve(solver="CLARABEL")
    assert objective(case, factor, fit.chi, weight) == pytest.approx(problem.value, rel=1e-5)
    np.testing.assert_allclose(case.base.values(fit.chi), case.base.values(chi.value), atol=1e-3)


def test_fixed_base_parameters_stay_exactly(trial):
    case = trial("kuka-iiwa7-r800", "none", seed=1)
    fit = closest_to_cad(case.prior, Coordinates.of(case.base), case.chi)
    np.testing.assert_allclose(case.base.values(fit.chi), case.beta, rtol=0, atol=1e-12)
    assert case.prior.divergence(fit.chi).sum() < case.prior.divergence(case.chi).sum()


@pytest.mark.parametrize("weight", [1e-1, 1.0, 1e3, 1e6])
def test_arrives_from_far_away(trial, around_cad, weight):
    case = trial("ur10e", noise=0.02, seed=6, duration=8.0, spread=0.5)
    limits = non_negative_drives(case.prior)
    one, other = (
        closest_to_cad(case.prior, Coordinates.of(case.base), start, weight=weight, factor=factor_of(case), bounds=limits)
        for start in (inside(case.prior), around_cad(case.prior, np.random.default_rng(7), 0.5))
    )
    assert one.value == pytest.approx(other.value, rel=1e-8)


def test_start_outside_is_refused(trial):
    case = trial("two-link", "none", seed=1, duration=4.0)
    with pytest.raises(IdentifiabilityError, match="inside the bounds"):
        closest_to_cad(case.prior, Coordinates.of(case.base), -case.chi)
