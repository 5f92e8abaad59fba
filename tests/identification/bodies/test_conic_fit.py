"""The conic program against an independent modelling of the same program, against first-order
optimality, and against bounds.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear

from asbuilt.description.inertia import pseudo_inertias
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.identification.bodies.body_bounds import (
    BodyBounds,
    bound_bodies,
    bound_generously,
    bound_passive_drives,
)
from asbuilt.identification.bodies.conic_fit import TINY_WEIGHT, ConicProblem


def factor_of(trial):
    noise = np.sqrt(trial.information.torque_energy / trial.information.n_samples) * 0.05
    return trial.information.stacked(1.0 / noise)


def objective(trial, factor, chi, weight):
    error = factor[:-1, :-1] @ (trial.base.regrouping @ chi) - factor[:-1, -1]
    step = chi - trial.prior.parameters
    n = trial.prior.n_links
    bodies = step[: 10 * n].reshape(n, 10)
    drives = step[10 * n :] / trial.prior.drive_scale
    pull = (
        weight * np.einsum("na,nab,nb->", bodies, trial.prior.metric, bodies)
        + min(weight, 1.0) * 1e-3 * drives @ drives
    )
    return 0.5 * (error @ error + pull)


@pytest.mark.parametrize("weight", [1.0, 100.0])
def test_same_minimum_as_an_independent_program(trial, weight):
    cp = pytest.importorskip("cvxpy")
    case = trial("two-link", "viscous,coulomb", noise=0.3, seed=4, duration=4.0)
    factor, bounds = factor_of(case), bound_passive_drives(case.prior)
    ours = ConicProblem(case.prior, case.base.regrouping, bounds, smallest_part=0.05).fit(
        factor, weight
    )
    chi = cp.Variable(case.base.n_standard)
    roots = np.linalg.cholesky(case.prior.metric)
    error = factor[:-1, :-1] @ case.base.regrouping @ chi - factor[:-1, -1]
    cost = cp.sum_squares(error) + min(weight, 1.0) * 1e-3 * cp.sum_squares(
        chi[20:] - case.prior.parameters[20:]
    )
    for i, root in enumerate(roots):
        cost += weight * cp.sum_squares(
            root.T @ (chi[10 * i : 10 * i + 10] - case.prior.parameters[10 * i : 10 * i + 10])
        )
    basis = pseudo_inertias(np.eye(10))
    above = [
        sum(chi[10 * i + a] * basis[a] for a in range(10)) - 0.05 * case.prior.pseudo_inertias[i]
        for i in range(2)
    ]
    problem = cp.Problem(cp.Minimize(0.5 * cost), [chi[20:] >= 0, *[body >> 0 for body in above]])
    problem.solve(solver="SCS", eps=1e-7, max_iters=100_000)
    assert objective(case, factor, ours, weight) == pytest.approx(problem.value, rel=1e-4)
    assert objective(case, factor, ours, weight) <= problem.value * (1 + 1e-4)
    np.testing.assert_allclose(case.base.values(ours), case.base.values(chi.value), atol=2e-3)


@pytest.mark.parametrize("weight", [TINY_WEIGHT, 1e3])
@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "scara", "puma-560"])
def test_no_drive_pushes_by_rounding(trial, robot, weight):
    """Torque of negative friction.

    The friction found is not 1e-9 below its bound either, which exports refuse.
    """
    for seed in range(2):
        case = trial(robot, "viscous,coulomb", noise=0.2, seed=seed, duration=2.0 + 2 * seed)
        factor, chi = factor_of(case).copy(), case.prior.parameters.copy()
        chi[case.prior.non_negative] = -np.abs(
            np.random.default_rng(seed).normal(size=len(case.prior.non_negative))
        )
        factor[:-1, -1] = factor[:-1, :-1] @ (case.base.regrouping @ chi)
        for bounds in (bound_generously(case.prior), bound_passive_drives(case.prior)):
            fit = ConicProblem(case.prior, case.base.regrouping, bounds).fit(factor, weight)
            assert np.all(fit[case.prior.non_negative] >= 0.0)


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "scara", "puma-560"])
def test_no_feasible_direction_goes_down(trial, around_cad, robot):
    """Variational inequality, which is KKT for a convex problem.

    The slope toward any feasible point is not negative.
    """
    case = trial(robot, noise=0.2, seed=1, duration=6.0, spread=0.5)
    factor, bounds = factor_of(case), bound_passive_drives(case.prior)
    weight = 1.0
    fit = ConicProblem(case.prior, case.base.regrouping, bounds).fit(factor, weight)
    here = objective(case, factor, fit, weight)
    rng = np.random.default_rng(0)
    for spread in (0.05, 0.3, 1.0):
        for _ in range(10):
            other = around_cad(case.prior, rng, spread)
            t = 1e-4
            assert objective(case, factor, (1 - t) * fit + t * other, weight) >= here - 1e-6 * abs(
                here
            )


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "scara", "puma-560", "ur10e", "franka-panda"])
def test_all_links_are_real_and_drives_passive_however_bad_the_data(trial, robot):
    case = trial(robot, noise=2.0, seed=2, duration=4.0)
    fit = ConicProblem(case.prior, case.base.regrouping, bound_generously(case.prior)).fit(
        factor_of(case)
    )
    assert case.prior.relative_eigenvalues(fit).min() >= 0.999e-3
    assert fit[case.prior.non_negative].min() >= -1e-6
    assert bound_generously(case.prior).slack(fit).min() >= -1e-5


def test_without_noise_the_truth_comes_back(trial):
    for robot in ("kuka-iiwa7-r800", "ur10e", "scara"):
        case = trial(robot, seed=3)
        fit = ConicProblem(case.prior, case.base.regrouping, bound_generously(case.prior)).fit(
            factor_of(case)
        )
        error = case.base.regrouping @ fit - case.beta
        assert (
            np.sqrt(
                case.information.residual_energy(case.beta + error).sum()
                / case.information.torque_energy.sum()
            )
            < 1e-4
        )
        assert case.prior.relative_eigenvalues(fit).min() > 0.1


def test_bounds_are_kept_and_named(trial):
    case = trial("ur10e", noise=0.1, seed=5, duration=6.0)
    masses = case.prior.parameters[9:60:10]
    given = bound_bodies(
        case.prior,
        mass={5: (2.0, 2.5), 1: (0.0, np.inf)},
        com={5: ([-0.01, -0.01, 0.0], [0.01, 0.01, 0.1])},
    )
    fit = ConicProblem(case.prior, case.base.regrouping, given).fit(factor_of(case), TINY_WEIGHT)
    body = fit[50:60]
    assert masses[5] < 2.0 - 1e-6 <= body[9] <= 2.5 + 1e-6
    assert np.all(np.abs(body[6:8] / body[9]) <= 0.0101)
    assert "m6 >= 2 kg" in given.labels


def test_impossible_bounds_are_refused(trial):
    case = trial("two-link", "none", noise=0.1, seed=5, duration=4.0)
    contradiction = bound_bodies(case.prior, mass={0: (3.0, 4.0)}).and_also(
        bound_bodies(case.prior, mass={0: (5.0, 6.0)})
    )
    with pytest.raises(IdentifiabilityError, match="widen"):
        ConicProblem(case.prior, case.base.regrouping, contradiction).fit(factor_of(case))
    with pytest.raises(UsageError, match="lower bound first"):
        bound_bodies(case.prior, mass={0: (4.0, 3.0)})
    with pytest.raises(UsageError, match="links 0 to 1"):
        bound_bodies(case.prior, com={2: ([0, 0, 0], [1, 1, 1])})


def test_a_panic_of_the_solver_is_told_as_any_failure(trial, monkeypatch):
    """Its exception is none of Python's `Exception`s and would end the program."""
    case = trial("two-link", "none", noise=0.1, seed=5, duration=4.0)

    class PanicException(BaseException):
        pass

    class Solver:
        def __init__(self, *_):
            pass

        def solve(self):
            raise PanicException("Eigval error")

    monkeypatch.setattr("clarabel.DefaultSolver", Solver)
    with pytest.raises(
        IdentifiabilityError, match=r"two-link .* solver status Panic \(Eigval error\)"
    ):
        ConicProblem(case.prior, case.base.regrouping).fit(factor_of(case))
    monkeypatch.setattr(Solver, "solve", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        ConicProblem(case.prior, case.base.regrouping).fit(factor_of(case))


def test_slack_of_bounds():
    bounds = BodyBounds(np.eye(2), np.array([0.0, 1.0]), ("a", "b"))
    np.testing.assert_allclose(bounds.slack([2.0, -3.0]), [2.0, -2.0])


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "ur10e", "scara"])
@pytest.mark.parametrize("weight", [1e1, 1e3, 1e6])
def test_bodies_that_are_real_anyway_need_no_cone(trial, monkeypatch, robot, weight):
    """Bounded least squares without cones (Stark & Parker's BVLS) and, to its lesser precision, the
    cone program itself find the same.
    """
    case = trial(robot, noise=0.3, seed=3, duration=6.0, spread=0.05)
    n = case.prior.n_links
    factor = 0.1 * factor_of(case)
    factor[:-1, -1] -= (
        1.5
        * factor[:-1, :-1]
        @ case.base.values(
            np.where(np.arange(len(case.chi)) % 3 == 0, case.chi, 0.0)
            * (np.arange(len(case.chi)) >= 10 * n)
        )
    )
    bounds = bound_passive_drives(case.prior)
    problem = ConicProblem(case.prior, case.base.regrouping, bounds)
    quick = problem.fit(factor, weight)
    monkeypatch.setattr(ConicProblem, "_inside", lambda *_: None)
    conic = problem.fit(factor, weight)
    needs_cone = np.array_equal(quick, conic)
    torque = factor[:-1, :-1] @ case.base.regrouping
    precision = 1e-8 * (objective(case, factor, conic, weight) + 2.0 * weight * n)
    assert np.linalg.norm(torque @ (quick - conic)) < np.sqrt(2.0 * precision) + 1e-6
    assert needs_cone != (case.prior.relative_eigenvalues(quick).min() > 1.001e-3)
    if needs_cone:
        assert weight < 1e6
        return
    assert np.any(np.abs(bounds.slack(quick)) < 1e-9)
    roots = [np.sqrt(weight) * np.linalg.cholesky(metric).T for metric in case.prior.metric]
    pull = block_diag(
        *roots, np.sqrt(min(weight, 1.0) * 1e-3) * np.diag(1.0 / case.prior.drive_scale)
    )
    lower = np.full(len(case.chi), -np.inf)
    lower[case.prior.non_negative] = 0.0
    scale = np.concatenate(
        [*(1.0 / np.linalg.norm(root, axis=0) for root in roots), case.prior.drive_scale]
    )
    rows, right = (
        np.vstack([torque, pull]),
        np.concatenate([factor[:-1, -1], pull @ case.prior.parameters]),
    )
    found = (
        lsq_linear(
            rows * scale, right, (lower, np.full_like(lower, np.inf)), method="bvls", tol=1e-14
        ).x
        * scale
    )
    assert objective(case, factor, quick, weight) == pytest.approx(
        objective(case, factor, found, weight), rel=1e-9
    )
    np.testing.assert_allclose(torque @ quick, torque @ found, atol=1e-5)
