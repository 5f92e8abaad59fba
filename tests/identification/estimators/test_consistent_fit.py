"""Consistent estimators on robots whose truth is known, on the recordings of real ones, and their
errors against repeated trials.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import LinkInertia, load_robot
from asbuilt.description.plausibility import find_inconsistencies
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import (
    SignalChain,
    hold_out,
    prepare_samples,
    read_recordings,
    resolve_chain,
)
from asbuilt.identification import (
    EstimationData,
    build_cad_prior,
    estimate_block_uncertainty,
    fit_least_squares,
    identify_samples,
    known_information,
    methods,
    noise_floor,
    summarise,
)
from asbuilt.identification.bodies.body_bounds import bound_bodies
from asbuilt.identification.bodies.consistency import decide_consistency
from asbuilt.identification.estimators.consistent_fit import (
    QUIETEST,
    choose_cad_weight,
    fit_consistent,
    fit_toward_cad,
    quietest_noise,
)
from asbuilt.identification.estimators.held_out_choice import DEFAULT_WEIGHT
from asbuilt.identification.information.square_root_information import accumulate
from studied_cases import first_of

ROBOTS = ["kuka-iiwa7-r800", "ur10e", "puma-560", "scara", "franka-panda"]


def fits(case):
    return {
        "consistent": fit_consistent(case.information, case.prior),
        "entropic": fit_toward_cad(case.information, case.prior),
        "euclidean": fit_toward_cad(case.information, case.prior, metric="euclidean"),
    }


def torque_error(case, beta):
    return np.sqrt(
        case.information.residual_energy(beta).sum() / case.information.torque_energy.sum()
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_without_noise_the_torques_of_the_truth_come_back(trial, robot):
    case = trial(robot, seed=3)
    for method, estimate in fits(case).items():
        assert torque_error(case, estimate.beta) < 1e-4, method


@pytest.mark.parametrize("robot", first_of(2, ROBOTS))
def test_every_estimate_is_real_and_the_prior_helps(trial, robot):
    case = trial(robot, noise=0.05, seed=4)
    free = fit_least_squares(
        case.information, weights="joint", prior=case.base.values(case.prior.parameters)
    )
    truth = trial(robot, noise=0.0, seed=4, chi=case.chi).information
    missed = {"wls": truth.residual_energy(free.beta).sum()}
    for method, estimate in fits(case).items():
        np.testing.assert_allclose(case.base.values(estimate.standard), estimate.beta)
        assert estimate.part > 0
        assert decide_consistency(case.base, estimate.beta)[1]
        assert estimate.standard[case.prior.non_negative].min() > -1e-6
        assert not find_inconsistencies(
            case.model.with_parameters(estimate.standard[: 10 * case.model.n_joints])
        )
        missed[method] = truth.residual_energy(estimate.beta).sum()
    assert missed["consistent"] < 1.05 * missed["wls"]
    assert missed["entropic"] < missed["wls"]
    assert missed["euclidean"] < missed["wls"]


@pytest.mark.parametrize("method", ["consistent", "entropic", "euclidean"])
def test_errors_are_those_of_the_dense_posterior(trial, method):
    """`s^2 K H^-1 K^T` in standard parameters, with mass ranges as uniform distributions.

    Kullback-Leibler's metric tr(P^-1 B_a P^-1 B_b), P halfway between CAD and estimate.
    """
    case = trial("scara", noise=0.05, seed=8)
    ranges = (((1, 2), 1.0, 30.0), ((3,), 0.0, np.inf))
    prior = replace(case.prior, mass_ranges=ranges)
    estimate = fits(replace(case, prior=prior))[method]
    K, n = case.base.regrouping, case.model.n_joints
    R = case.information.stacked(estimate.weights)
    H = K.T @ R[:-1, :-1].T @ R[:-1, :-1] @ K
    for i in range(n):
        own = slice(10 * i, 10 * i + 10)
        middle = 0.5 * (prior.parameters[own] + estimate.standard[own])
        inverse = np.linalg.inv(LinkInertia(middle).pseudo_inertia)
        moves = [inverse @ LinkInertia(unit).pseudo_inertia for unit in np.eye(10)]
        metric = [[np.trace(one @ other) for one in moves] for other in moves]
        H[own, own] += estimate.belief * prior.strength[i] * np.array(metric)
    drives = np.arange(10 * n, len(H))
    H[drives, drives] += prior.drive_weight / prior.drive_scale**2
    both = np.isin(np.arange(len(H)), [19, 29]).astype(float)
    H += np.outer(both, both) * 12.0 / (30.0 - 1.0) ** 2
    scale = 1.0 / np.sqrt(np.diag(H))
    inverse = np.outer(scale, scale) * np.linalg.inv(np.outer(scale, scale) * H)
    error = R @ np.append(-estimate.beta, 1.0)
    rank = np.linalg.matrix_rank(R[:-1, :-1] / np.linalg.norm(R[:-1, :-1], axis=0), tol=1e-10)
    unexplained = error @ error / (case.information.n_samples * n - rank)
    dense = max(unexplained, 1.0) * K @ inverse @ K.T
    np.testing.assert_allclose(estimate.std_errors, np.sqrt(np.diag(dense)), rtol=1e-6)
    np.testing.assert_allclose(estimate.covariance, dense, atol=1e-6 * np.diag(dense).max())


@pytest.mark.parametrize("weight", [0.2, 3.0])
def test_the_belief_in_cad_is_what_the_distance_from_it_supports(trial, weight):
    """Determined parameters over twice the divergence, both from dense matrices.

    `10 n - w tr(H^-1 M)` parameters are determined, with w M the information of CAD in H; the
    divergence is `tr(P0^-1 P) - log det(P0^-1 P) - 4`.
    """
    case = trial("scara", noise=0.05, seed=8, spread=0.2)
    prior, K, n = case.prior, case.base.regrouping, case.model.n_joints
    estimate = fit_toward_cad(case.information, prior, weight=weight)
    R = case.information.stacked(estimate.weights)[:-1, :-1] @ K
    M = np.zeros((len(prior.parameters),) * 2)
    away = 0.0
    for i in range(n):
        own = slice(10 * i, 10 * i + 10)
        cad, found = (LinkInertia(each[own]) for each in (prior.parameters, estimate.standard))
        middle = 0.5 * (prior.parameters[own] + estimate.standard[own])
        inverse = np.linalg.inv(LinkInertia(middle).pseudo_inertia)
        moves = [inverse @ LinkInertia(unit).pseudo_inertia for unit in np.eye(10)]
        M[own, own] = [[np.trace(one @ other) for one in moves] for other in moves]
        M[own, own] *= prior.strength[i]
        ratio = np.linalg.solve(cad.pseudo_inertia, found.pseudo_inertia)
        away += prior.strength[i] * (np.trace(ratio) - np.log(np.linalg.det(ratio)) - 4.0)
    H = R.T @ R + weight * M
    drives = np.arange(10 * n, len(H))
    H[drives, drives] += prior.drive_weight / prior.drive_scale**2
    scale = 1.0 / np.sqrt(np.diag(H))
    inverse = np.outer(scale, scale) * np.linalg.inv(np.outer(scale, scale) * H)
    expected = (10 * n - weight * np.trace(inverse @ M)) / (2.0 * away)
    found = choose_cad_weight(case.information, prior, estimate.weights, estimate.standard, weight)
    assert found == pytest.approx(expected, rel=1e-6)
    assert estimate.belief == pytest.approx(min(weight, expected), rel=1e-6)
    assert f"Standard errors use CAD with weight {estimate.belief:.3g}" in estimate.notes


def test_the_quietest_noise_is_a_share_of_the_torque(trial):
    """Whatever the unit of torque; the floor at a joint of no torque, none without a sensor."""
    case = trial("scara", noise=0.05, seed=8)
    n = case.information.n_samples
    for size in (1.0, 1e-4):
        tau = size * case.samples.tau * [1.0, 1.0, 0.0, 1.0]
        information = accumulate(
            case.model, case.base, replace(case.samples, tau=tau, tau_raw=np.zeros(0))
        )
        rms = np.sqrt(np.sum(tau**2, axis=0) / n)
        noise = quietest_noise(information)
        np.testing.assert_allclose(noise[[0, 1, 3]], QUIETEST * rms[[0, 1, 3]], rtol=1e-9)
        assert noise[2] == noise_floor(information) > 0.0
    gone = replace(
        information,
        factors=(*information.factors[:3], np.zeros_like(information.factors[3])),
        torque_sum=information.torque_sum.copy(),
    )
    assert quietest_noise(gone)[3] == np.inf


def test_parameters_that_nothing_determines_are_refused_if_asked(trial):
    case = trial("scara", noise=0.05, seed=8)
    still = replace(case.samples, qd=0.0 * case.samples.qd, qdd=0.0 * case.samples.qdd)
    held = accumulate(case.model, case.base, still)
    for method in ("consistent", "entropic", "euclidean"):
        data = EstimationData(case.model, held, undetermined="refuse")
        with pytest.raises(IdentifiabilityError):
            methods[method].estimate(data)


def test_the_weight_follows_how_far_cad_is_off(trial):
    exact = trial("kuka-iiwa7-r800", noise=0.2, seed=5, spread=1e-3)
    wrong = trial("kuka-iiwa7-r800", noise=0.002, seed=5, spread=0.4)
    near, far = (fit_toward_cad(case.information, case.prior) for case in (exact, wrong))
    assert near.prior_weight >= 100.0 * far.prior_weight
    assert near.belief == 25.0, "CAD is accurate to a fifth at best"
    assert near.notes[0].startswith(f"weight of CAD {near.prior_weight:g}: the largest")
    few = exact.information.select([0, 1])
    assert fit_toward_cad(few, exact.prior).prior_weight == DEFAULT_WEIGHT


def test_given_weight_bounds_and_joint_weights(trial):
    case = trial("ur10e", noise=0.05, seed=6)
    heavy = bound_bodies(case.prior, mass={5: (2.0, 3.0)})
    for metric in ("entropic", "euclidean"):
        estimate = fit_toward_cad(
            case.information,
            case.prior,
            metric=metric,
            weight=50.0,
            bounds=heavy,
            weights=np.full(6, 2.0),
        )
        assert estimate.prior_weight == 50.0
        assert estimate.notes[0] == "weight of CAD 50"
        assert 2.0 - 1e-6 <= estimate.standard[59] <= 3.0 + 1e-6
        np.testing.assert_array_equal(estimate.weights, 2.0)
    text = fit_consistent(case.information, case.prior, bounds=heavy).notes[0]
    assert text.endswith("active of 2 bounds: m6 >= 2 kg")
    with pytest.raises(UsageError, match="entropic, euclidean"):
        fit_toward_cad(case.information, case.prior, metric="manhattan")


@pytest.mark.study
@pytest.mark.parametrize("method", ["consistent", "entropic"])
def test_errors_are_not_too_small(trial, method):
    """Over repeated noise, and with a truth as far from CAD as its own weight says, the estimate
    lies within its errors.
    """
    inside, asked = 0, 0
    for seed in range(12):
        case = trial("scara", "viscous,coulomb", noise=0.05, seed=100 + seed, duration=16.0)
        estimate = (
            fit_consistent(case.information, case.prior)
            if method == "consistent"
            else fit_toward_cad(case.information, case.prior)
        )
        error = (estimate.beta - case.beta) / estimate_block_uncertainty(
            case.information, estimate
        ).std_errors
        inside, asked = inside + int(np.sum(np.abs(error) < 1.96)), asked + len(error)
    assert inside / asked > 0.93


def test_unexcited_directions_lie_at_cad(trial):
    """Only the last two joints move.

    What links 1 to 5 are stays as described, and what is told is told.
    """
    case = trial("kuka-iiwa7-r800", "none", seed=7)
    q, qd, qdd = (values.copy() for values in (case.samples.q, case.samples.qd, case.samples.qdd))
    q[:, :5], qd[:, :5], qdd[:, :5] = 0.3, 0.0, 0.0
    W = observation_matrix(case.model, q, qd, qdd, drive=case.base.drive, columns=case.base.columns)
    chi = np.concatenate([case.prior.parameters[:50], case.chi[50:]])
    samples = replace(
        case.samples,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=(W @ case.base.values(chi)).reshape(q.shape),
        tau_raw=np.zeros(0),
    )
    information = accumulate(case.model, case.base, samples)
    estimate = fit_consistent(information, case.prior)
    assert len(estimate.undetermined) > 10
    assert (
        np.sqrt(information.residual_energy(estimate.beta).sum() / information.torque_energy.sum())
        < 1e-4
    )
    assert case.prior.divergence(estimate.standard)[:3].max() < 0.05
    errors = estimate_block_uncertainty(information, estimate).std_errors
    assert np.all(errors[~estimate.determined] > 0)


@pytest.mark.parametrize("method", ["wls", "entropic"])
def test_what_is_known_is_the_inverse_of_the_covariance(trial, method):
    """Estimates that lean on CAD have errors in every direction, also where the recording tells
    nothing; weighted least squares has none there.
    """
    case = trial("kuka-iiwa7-r800", "viscous,coulomb", noise=0.02, seed=7)
    q, qd, qdd = (values.copy() for values in (case.samples.q, case.samples.qd, case.samples.qdd))
    q[:, 5:], qd[:, 5:], qdd[:, 5:] = 0.3, 0.0, 0.0
    W = observation_matrix(case.model, q, qd, qdd, drive=case.base.drive, columns=case.base.columns)
    tau = (W @ case.beta).reshape(q.shape) + 0.05 * np.random.default_rng(0).normal(size=q.shape)
    result = identify_samples(
        case.model,
        replace(case.samples, q=q, qd=qd, qdd=qdd, tau=tau, tau_raw=np.zeros(0)),
        base=case.base,
        method=method,
    )
    assert result.rank < result.n_base
    known, size = known_information(result), np.sqrt(np.diag(result.covariance))
    scaled, covariance = (
        known * np.outer(size, size),
        result.covariance / np.outer(np.where(size > 0, size, 1.0), np.where(size > 0, size, 1.0)),
    )
    np.testing.assert_allclose(covariance @ scaled @ covariance, covariance, atol=1e-6)
    assert np.linalg.matrix_rank(scaled, tol=1e-6) == (
        result.rank if method == "wls" else result.n_base
    )


def med7(shared, log, rule):
    model = load_robot(shared / "models" / "lbrstack_med7.urdf")
    recordings = read_recordings(
        [shared / "data" / "lbr_med7" / log], model=model, rate=100.0, flip_torque=True
    )
    chain = resolve_chain(SignalChain(), *recordings)
    samples = prepare_samples(recordings[0], replace(chain, parallel_cutoff=chain.cutoff))
    return model, *hold_out(samples, rule)


@pytest.mark.parametrize(
    ("log", "rule", "no_worse"),
    [
        (
            "measurements_with_ext_tau_1_dgr.csv",
            "blocks:5s:3",
            [0.57, 0.41, 0.39, 0.47, 0.13, 0.12, 0.09],
        ),
        ("measurements.csv", "last:0.3", [0.6, 0.9, 0.4, 0.6, 0.3, 0.12, 0.16]),
    ],
)
def test_held_out_torque_of_a_real_arm(shared, log, rule, no_worse):
    """The level of plain least squares on the long recording.

    The short one it cannot learn at all (1.4, 2.4, 1.3, 1.9 on joints 1 to 4).
    """
    model, train, held = med7(shared, log, rule)
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    information, other = accumulate(model, base, train), accumulate(model, base, held)
    prior = build_cad_prior(model, base.drive)
    for estimate, share in (
        (fit_consistent(information, prior), 1.0),
        (fit_toward_cad(information, prior), 1.05),
    ):
        rms = np.sqrt(other.residual_energy(estimate.beta) / other.n_samples)
        np.testing.assert_array_less(rms, share * np.array(no_worse))
        assert np.sqrt(np.mean(rms**2)) < np.sqrt(np.mean(np.square(no_worse)))
        assert estimate.part > 0


@pytest.mark.study
def test_result_says_method_margin_and_weight(shared):
    model, train, _ = med7(shared, "measurements_with_ext_tau_1_dgr.csv", "blocks:5s:3")
    for method in ("consistent", "entropic", "euclidean"):
        result = identify_samples(
            model, train, drive=DriveSet.parse("viscous,coulomb,offset"), method=method
        )
        assert result.physically_consistent
        text = summarise(result).as_text()
        assert "physically consistent" in text.splitlines()[0]
        assert any("physically consistent" in note for note in result.notes)
        assert result.std_errors.min() > 0


@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_bodies_far_from_cad_are_reached(trial, weight):
    """A tool of 10 kg that CAD does not know, noisy torques: a descent straight from CAD stalls."""
    bare = trial("ur10e", "armature,viscous,coulomb,offset", seed=12, duration=10.0)
    chi = bare.chi.copy()
    chi[50:60] += LinkInertia.from_com(10.0, [0.0, -0.16, 0.05], 0.02 * np.eye(3)).parameters
    case = trial(
        "ur10e", "armature,viscous,coulomb,offset", noise=0.05, seed=12, duration=10.0, chi=chi
    )
    found = fit_toward_cad(case.information, case.prior, weight=weight)
    assert found.part > 0.0
    place = case.base.names.index("my6")
    np.testing.assert_allclose(found.beta[place], case.beta[place], rtol=0.1)


@pytest.mark.parametrize("method", ["consistent", "entropic", "euclidean"])
def test_torques_of_zero_are_fitted_without_overflow(trial, method):
    """No noise and no torque: weights and values stay finite."""
    case = trial("two-link", seed=1)
    still = replace(case.samples, tau=np.zeros_like(case.samples.tau), tau_raw=np.zeros(0))
    with np.errstate(over="raise", invalid="raise"):
        estimate = methods[method].estimate(
            EstimationData(case.model, accumulate(case.model, case.base, still), None)
        )
    assert np.all(np.isfinite(estimate.beta))
    assert np.all(np.isfinite(estimate.weights))
