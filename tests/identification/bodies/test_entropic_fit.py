"""The entropic fit against derivatives by differences, a descent in other coordinates, and an
independent modelling of the same program.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from asbuilt.description import LinkInertia
from asbuilt.description.inertia import pseudo_inertias
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies import entropic_fit
from asbuilt.identification.bodies.body_bounds import bound_passive_drives
from asbuilt.identification.bodies.cad_prior import smat
from asbuilt.identification.bodies.entropic_fit import (
    BARRIER,
    Coordinates,
    EntropicProblem,
    _Search,
)
from asbuilt.identification.bodies.entropic_path import EntropicPath
from log_cholesky import from_log_cholesky, log_cholesky


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


def closest(case, start, *, weight=1.0, factor=None, bounds=None, barrier=BARRIER):
    problem = EntropicProblem(case.prior, Coordinates.of(case.base), bounds, held=factor is None)
    return problem.fit(
        None if factor is None else factor[None], weight, start[None], barrier=barrier
    )


@pytest.mark.parametrize("robot", ["two-link", "scara", "puma-560", "kuka-iiwa7-r800"])
def test_gradient_and_hessian_by_differences(trial, around_cad, robot):
    case = trial(robot, noise=0.1, seed=1, duration=6.0)
    rng = np.random.default_rng(0)
    chi = around_cad(case.prior, rng, 0.1)
    for factors in (None, 1e-2 * factor_of(case)[None]):
        problem = EntropicProblem(
            case.prior,
            Coordinates.of(case.base),
            bound_passive_drives(case.prior),
            held=factors is None,
        )

        def at(step, problem=problem, factors=factors):
            search = _Search(problem, factors, 3.0, 0.1, (chi + problem.free @ step)[None])
            gradient, T, V = search.model(slice(None))
            hessian = search.hessians(np.arange(1), T)
            return search.values[0], *(each[0] for each in (gradient, hessian, T, V))

        gradient, hessian, T, V = at(np.zeros(problem.free.shape[1]))[1:]
        Q = smat((problem.whitening @ chi)[: problem.inertial].reshape(-1, 10))
        np.testing.assert_allclose(
            T @ Q @ T.transpose(0, 2, 1), V[:, :, None] * np.eye(4), atol=1e-10
        )
        for _ in range(4):
            step = rng.normal(size=len(gradient))
            scale = np.sqrt(step @ hessian @ step)
            step *= 1e-4 / scale
            ahead, behind = at(step), at(-step)
            assert (ahead[0] - behind[0]) / 2 == pytest.approx(
                gradient @ step, abs=1e-12 + 1e-9 * abs(ahead[0])
            )
            curved = hessian @ step
            np.testing.assert_allclose(
                (ahead[1] - behind[1]) / 2, curved, rtol=1e-5, atol=1e-5 * np.abs(curved).max()
            )


@pytest.mark.parametrize("at_once", [1, 2**22])
def test_many_problems_side_by_side_are_solved_as_each_alone(trial, monkeypatch, at_once):
    monkeypatch.setattr(entropic_fit, "HESSIANS_AT_ONCE", at_once)
    case = trial("ur10e", noise=0.05, seed=3, duration=8.0, spread=0.5)
    limits = bound_passive_drives(case.prior)
    factors = np.array([scale * factor_of(case) for scale in (0.1, 1.0, 3.0)])
    start = np.array([inside(case.prior)] * 3)
    problem = EntropicProblem(case.prior, Coordinates.of(case.base), limits)
    together = problem.fit(factors, 1.0, start)
    warm = problem.fit(factors, 1.0, problem.fit(factors, 100.0, start, close=1e-3))
    for k, factor in enumerate(factors):
        alone = closest(case, start[k], factor=factor, bounds=limits)
        for other in (together, warm):
            assert other.values[k] == pytest.approx(alone.values[0], rel=1e-10)
            np.testing.assert_allclose(
                case.base.values(other.chi[k]), case.base.values(alone.chi[0]), rtol=1e-5, atol=1e-6
            )


@pytest.mark.parametrize("robot", ["two-link", "scara"])
@pytest.mark.parametrize("weight", [1.0, 30.0])
@pytest.mark.study
def test_same_minimum_as_a_descent_in_log_cholesky_coordinates(trial, robot, weight):
    """Rucker & Wensing (2022).

    Any ten numbers per link are a real body, so a general minimiser needs no constraints.
    """
    case = trial(robot, "none", noise=0.5, seed=2, duration=5.0, spread=0.3)
    factor = factor_of(case)
    fit = closest(case, inside(case.prior), weight=weight, factor=factor)
    n = case.prior.n_links

    def bodies(theta):
        return np.concatenate([from_log_cholesky(row).parameters for row in theta.reshape(n, 10)])

    start = np.concatenate(
        [log_cholesky(LinkInertia(body)) for body in case.prior.parameters.reshape(n, 10)]
    )
    found = minimize(
        lambda theta: objective(case, factor, bodies(theta), weight),
        start,
        method="BFGS",
        options={"maxiter": 3000, "gtol": 1e-4},
    )
    assert objective(case, factor, fit.chi[0], weight) <= found.fun * (1 + 1e-9)
    assert objective(case, factor, fit.chi[0], weight) == pytest.approx(found.fun, rel=1e-3)


def test_same_minimum_as_an_independent_conic_program(trial):
    cp = pytest.importorskip("cvxpy")
    case = trial("two-link", "viscous,coulomb", noise=0.5, seed=4, duration=4.0)
    factor = 0.1 * factor_of(case)
    weight = 2.0
    limits = bound_passive_drives(case.prior)
    fit = closest(
        case, inside(case.prior), weight=weight, factor=factor, bounds=limits, barrier=1e-8
    )
    chi, basis = cp.Variable(case.base.n_standard), pseudo_inertias(np.eye(10))
    cost = 0.5 * cp.sum_squares(factor[:-1, :-1] @ case.base.regrouping @ chi - factor[:-1, -1])
    for i, P0 in enumerate(case.prior.pseudo_inertias):
        inverse = np.linalg.inv(np.linalg.cholesky(P0))
        whitened = sum(chi[10 * i + a] * (inverse @ basis[a] @ inverse.T) for a in range(10))
        cost += weight * (cp.trace(whitened) - cp.log_det(whitened) - 4)
    problem = cp.Problem(cp.Minimize(cost), [chi[20:] >= 0])
    problem.solve(solver="CLARABEL")
    assert objective(case, factor, fit.chi[0], weight) == pytest.approx(problem.value, rel=1e-5)
    np.testing.assert_allclose(case.base.values(fit.chi[0]), case.base.values(chi.value), atol=1e-3)


def test_fixed_base_parameters_stay_exactly(trial):
    case = trial("kuka-iiwa7-r800", "none", seed=1)
    fit = closest(case, case.chi)
    np.testing.assert_allclose(case.base.values(fit.chi[0]), case.beta, rtol=0, atol=1e-12)
    assert case.prior.divergence(fit.chi[0]).sum() < case.prior.divergence(case.chi).sum()


@pytest.mark.parametrize("weight", [1e-1, 1.0, 1e3, 1e6])
def test_arrives_from_far_away(trial, around_cad, weight):
    case = trial("ur10e", noise=0.02, seed=6, duration=8.0, spread=0.5)
    limits = bound_passive_drives(case.prior)
    one, other = (
        closest(case, start, weight=weight, factor=factor_of(case), bounds=limits)
        for start in (inside(case.prior), around_cad(case.prior, np.random.default_rng(7), 0.5))
    )
    assert one.values[0] == pytest.approx(other.values[0], rel=1e-8)


def test_start_outside_is_refused(trial):
    case = trial("two-link", "none", seed=1, duration=4.0)
    with pytest.raises(IdentifiabilityError, match="inside the bounds"):
        closest(case, -case.chi)


def test_a_path_gives_the_fits_of_the_factors_that_are_asked(trial):
    """What was reached for other factors may be a start, and is no answer."""
    case = trial("two-link", "viscous,coulomb", noise=0.1, seed=3, duration=4.0)
    factor = factor_of(case)
    other = factor.copy()
    other[:, -1] *= 1.05
    path = EntropicPath(case.prior, case.base, bound_passive_drives(case.prior))
    path.fit_descending(other[None], [10.0, 1.0])
    factors = factor[None]
    path.fit_roughly(factors, 10.0)
    asked = path.fit_descending(factors, [1.0])[1.0][0]
    exact = path.fit_exactly(factor, 1.0)
    away = factor[:-1, :-1] @ (case.base.regrouping @ (asked - exact))
    assert away @ away < 1e-2
    moved = path.fit_exactly(other, 1.0)
    assert np.linalg.norm(factor[:-1, :-1] @ (case.base.regrouping @ (moved - exact))) > 1.0
