"""Least squares against certified data, against a direct solve, and where the data leave something
open.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix, parameter_values
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import Samples
from asbuilt.identification import fit_least_squares, solve_factor, triangular_factor
from asbuilt.identification.information.square_root_information import accumulate

DRIVE = DriveSet.parse("viscous,coulomb,offset")
NIST = Path(__file__).parent / "nist"
DIGITS = {
    "Norris": (12, 12),
    "Pontius": (11, 12),
    "NoInt1": (13, 13),
    "NoInt2": (13, 13),
    "Longley": (11, 12),
    "Wampler1": (8.5, 8.5),
    "Wampler2": (12, 12),
    "Wampler3": (8.5, 12),
    "Wampler4": (7.5, 12),
    "Wampler5": (5.5, 12),
    "Filip": (7, 7),
}
"""Digits of (estimates, standard errors) that double precision reaches on data as printed."""


def design_matrix(certified):
    x = np.array(certified["x"], dtype=float)
    kind, *degree = certified["model"].split()
    if kind == "slope":
        return x[:, None]
    if kind == "linear":
        return np.column_stack([np.ones(len(x)), x])
    return np.vander(x, int(degree[0]) + 1, increasing=True)


def digits(found, certified):
    certified = np.array(certified)
    error = np.abs(found - certified) / np.where(certified == 0, 1.0, np.abs(certified))
    return -np.log10(max(error.max(), 1e-15))


@pytest.mark.parametrize("name", DIGITS)
def test_certified_regressions_of_nist(name):
    certified = json.loads((NIST / f"{name}.json").read_text())
    x, y = design_matrix(certified), np.array(certified["y"], dtype=float)
    solution = solve_factor(triangular_factor(np.column_stack([x, y])), len(y))
    variance = solution.residual_energy / (len(y) - solution.rank)
    errors = np.sqrt(variance * np.sum(solution.inverse_root**2, axis=1))
    assert solution.rank == x.shape[1]
    assert digits(solution.x, certified["estimate"]) >= DIGITS[name][0]
    assert digits(errors, certified["std_error"]) >= DIGITS[name][1]
    assert digits(np.sqrt(variance), certified["residual_std"]) >= DIGITS[name][1] - 0.5


@pytest.fixture(scope="module")
def robot():
    model = load_robot("kuka-iiwa7-r800")
    base = find_base_parameters(model, DRIVE)
    chi = parameter_values(model, DRIVE)
    chi[70:] = np.tile([0.8, 1.5, -0.2], 7)
    return model, base, base.values(chi)


def moved(model, base, beta, noise, n_samples=800, seed=0, still=()):
    rng = np.random.default_rng(seed)
    n = model.n_joints
    q, qd, qdd = rng.uniform(-2, 2, (3, n_samples, n))
    for joint in still:
        q[:, joint], qd[:, joint], qdd[:, joint] = 0.3, 0.0, 0.0
    w = observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)
    tau = (w @ beta).reshape(-1, n) + np.broadcast_to(noise, n) * rng.normal(size=(n_samples, n))
    return (
        Samples(
            np.arange(n_samples) / 100.0, q, qd, qdd, tau, rate=100.0, joint_names=model.joint_names
        ),
        w,
    )


def test_noise_free_torque_gives_the_parameters_back(robot):
    model, base, beta = robot
    samples, _ = moved(model, base, beta, 0.0)
    for weights in (None, "joint"):
        estimate = fit_least_squares(accumulate(model, base, samples), weights=weights)
        assert np.allclose(estimate.beta, beta, rtol=0, atol=1e-10)
        assert estimate.rank == base.n_base
        assert estimate.determined.all()


def test_joint_weights_converge_to_the_fixed_point_of_a_direct_solve(robot):
    model, base, beta = robot
    noise = np.array([0.1, 3.0, 0.5, 2.0, 0.2, 0.1, 0.05])
    samples, w = moved(model, base, beta, noise)
    estimate = fit_least_squares(accumulate(model, base, samples), weights="joint")
    rows = w.reshape(-1, 7, base.n_base)
    weighted = rows / estimate.sigma[:, None]
    direct = np.linalg.lstsq(
        weighted.reshape(-1, base.n_base), (samples.tau / estimate.sigma).ravel(), rcond=None
    )[0]
    assert np.allclose(estimate.beta, direct, rtol=1e-7, atol=1e-9)
    information = np.linalg.inv(np.einsum("tkp,tkq->pq", weighted, weighted))
    assert np.allclose(estimate.covariance, information, rtol=1e-6, atol=1e-9 * information.max())
    spent = np.einsum("tkp,pq,tkq->k", weighted, information, weighted)
    assert spent.sum() == pytest.approx(base.n_base)
    error = samples.tau - rows @ estimate.beta
    assert np.allclose(
        estimate.sigma, np.sqrt((error**2).sum(axis=0) / (len(error) - spent)), rtol=1e-6
    )
    assert np.allclose(estimate.sigma, noise, rtol=0.1)
    assert estimate.converged


def test_weights_lower_the_error_where_noise_differs(robot):
    model, base, beta = robot
    noise = np.array([0.1, 3.0, 0.5, 2.0, 0.2, 0.1, 0.05])
    plain, weighted = [], []
    for seed in range(8):
        information = accumulate(model, base, moved(model, base, beta, noise, 200, seed)[0])
        spread = np.sqrt(np.diag(fit_least_squares(information, weights="joint").covariance))
        plain.append((fit_least_squares(information).beta - beta) / spread)
        weighted.append((fit_least_squares(information, weights="joint").beta - beta) / spread)
    assert np.square(weighted).mean() < 0.5 * np.square(plain).mean()


@pytest.mark.study
def test_standard_errors_are_the_scatter_of_repeated_experiments(robot):
    model, base, beta = robot
    noise = np.array([0.1, 3.0, 0.5, 2.0, 0.2, 0.1, 0.05])
    deviations = []
    for seed in range(60):
        estimate = fit_least_squares(
            accumulate(model, base, moved(model, base, beta, noise, 150, seed)[0]), weights="joint"
        )
        deviations.append((estimate.beta - beta) / estimate.std_errors)
    z = np.array(deviations)
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.1)
    assert np.mean(np.abs(z) < 1.96) == pytest.approx(0.95, abs=0.015)


def test_ordinary_least_squares_has_the_textbook_covariance(robot):
    model, base, beta = robot
    samples, w = moved(model, base, beta, 0.5)
    estimate = fit_least_squares(accumulate(model, base, samples))
    error = samples.tau.ravel() - w @ estimate.beta
    expected = error @ error / (len(error) - base.n_base) * np.linalg.inv(w.T @ w)
    assert np.allclose(estimate.covariance, expected, rtol=1e-7, atol=1e-10 * expected.max())


def test_a_standing_joint_leaves_directions_open_which_are_named_and_kept_at_cad(robot):
    model, base, beta = robot
    samples, w = moved(model, base, beta, 0.01, still=(6,))
    information = accumulate(model, base, samples)
    cad = beta + 0.1
    estimate = fit_least_squares(information, weights="joint", prior=cad)
    assert estimate.rank == np.linalg.matrix_rank(w) < base.n_base
    assert (
        len(estimate.undetermined)
        == base.n_base - estimate.rank
        == len(estimate.solution.open_directions)
    )
    assert np.allclose(w @ estimate.solution.open_directions.T, 0, atol=1e-9)
    assert {"Fv7", "Fc7"} <= set(estimate.undetermined)
    names = list(base.names)
    for name in ("Fv7", "Fc7"):
        j = names.index(name)
        assert not estimate.determined[j]
        assert estimate.beta[j] == pytest.approx(cad[j])
        assert estimate.covariance[j, j] == 0.0
    assert estimate.determined[names.index("Fv1")]
    assert np.allclose(w @ estimate.beta, w @ beta, atol=0.05)
    other = fit_least_squares(information, weights="joint", prior=beta)
    null = estimate.solution.open_directions
    shift = estimate.beta - other.beta
    assert np.allclose(null.T @ np.linalg.lstsq(null.T, shift, rcond=None)[0], shift, atol=1e-8)


def test_resolution_toward_cad_is_the_smallest_change_in_equal_torque(robot):
    model, base, beta = robot
    samples, w = moved(model, base, beta, 0.01, still=(3, 6))
    cad = beta + 0.1
    estimate = fit_least_squares(accumulate(model, base, samples), prior=cad)
    length = np.linalg.norm(w, axis=0)
    scale = np.where(length > 0, length, 1.0)
    expected = (
        cad + np.linalg.pinv(w / scale, rcond=1e-10) @ (samples.tau.ravel() - w @ cad) / scale
    )
    assert np.allclose(estimate.beta, expected, atol=1e-8)


def test_what_is_open_can_be_refused(robot):
    model, base, beta = robot
    information = accumulate(model, base, moved(model, base, beta, 0.01, still=(6,))[0])
    with pytest.raises(
        IdentifiabilityError, match=r"determines \d+ of 64 parameters.*Fv7.*move the joints"
    ):
        fit_least_squares(information, prior=beta, undetermined="refuse")
    with pytest.raises(IdentifiabilityError, match="toward CAD"):
        fit_least_squares(information)


def test_a_robot_at_rest_keeps_its_cad_values_except_what_gravity_tells(robot):
    model, base, beta = robot
    samples, w = moved(model, base, beta, 0.0, 50, still=range(7))
    estimate = fit_least_squares(accumulate(model, base, samples), prior=beta)
    assert estimate.rank == np.linalg.matrix_rank(w)
    assert np.allclose(estimate.beta, beta, atol=1e-9)
    assert np.isinf(estimate.solution.condition_number)


def test_too_few_samples_and_wrong_weights_are_errors(robot):
    model, base, beta = robot
    information = accumulate(model, base, moved(model, base, beta, 0.1, 9)[0])
    with pytest.raises(
        IdentifiabilityError, match="9 samples of 7 joints give 63 torques, too few for 64"
    ):
        fit_least_squares(information)
    enough = accumulate(model, base, moved(model, base, beta, 0.1, 50)[0])
    with pytest.raises(UsageError, match="7 positive numbers"):
        fit_least_squares(enough, weights=[1.0, 2.0])
    with pytest.raises(UsageError, match="'joints' are unknown"):
        fit_least_squares(enough, weights="joints")


def test_given_weights_are_used_as_they_are(robot):
    model, base, beta = robot
    samples, w = moved(model, base, beta, 0.3)
    weights = np.arange(1.0, 8.0)
    estimate = fit_least_squares(accumulate(model, base, samples), weights=weights)
    rows = (w.reshape(-1, 7, base.n_base) * weights[:, None]).reshape(-1, base.n_base)
    assert np.allclose(
        estimate.beta,
        np.linalg.lstsq(rows, (samples.tau * weights).ravel(), rcond=None)[0],
        rtol=1e-9,
        atol=1e-11,
    )


def test_rows_may_be_scaled_without_changing_the_answer(robot):
    model, base, beta = robot
    samples, _ = moved(model, base, beta, 0.3)
    estimate = fit_least_squares(accumulate(model, base, samples), weights="joint")
    tenfold = fit_least_squares(
        accumulate(model, base, replace(samples, tau=10 * samples.tau, tau_raw=np.empty((0, 0)))),
        weights="joint",
    )
    assert np.allclose(tenfold.beta, 10 * estimate.beta, rtol=1e-8, atol=1e-10)
    assert np.allclose(tenfold.std_errors, 10 * estimate.std_errors, rtol=1e-7)
