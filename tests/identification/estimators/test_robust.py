"""Robust fits against scipy's, and in recordings with collisions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from three_links import DRIVE, full_rows, recording

from asbuilt.identification import EstimationData, accumulate_stream, identify_samples, methods
from asbuilt.identification.estimators import robust


@pytest.fixture(scope="module")
def clean(robot):
    model, base, beta = robot
    return recording(model, base, beta, noise=0.2, seconds=40.0, seed=5)


@pytest.fixture(scope="module")
def struck(robot, clean):
    """The same recording with two collisions, 0.6 s each, and a burst of bad samples."""
    tau = clean.tau.copy()
    for start, push in ((400, [25.0, 15.0, 6.0]), (1300, [-20.0, 18.0, 5.0])):
        tau[start : start + 30] += push
    tau[900:910] *= -1.0
    return replace(clean, tau=tau, tau_raw=np.empty((0, 0)))


def test_huber_is_the_minimum_that_scipy_finds(robot, struck):
    model, base, _ = robot
    data = EstimationData(model, accumulate_stream(model, base, [struck]), [struck])
    estimate = methods["huber"].estimate(data)
    joints = full_rows(model, base, struck)
    size = np.linalg.norm(
        np.vstack([W / s for (W, _), s in zip(joints, estimate.sigma, strict=True)]), axis=0
    )
    A = np.vstack([W / s for (W, _), s in zip(joints, estimate.sigma, strict=True)]) / size
    y = np.concatenate([tau / s for (_, tau), s in zip(joints, estimate.sigma, strict=True)])
    solved = least_squares(
        lambda x: A @ x - y,
        np.zeros(base.n_base),
        jac=lambda x: A.copy(),  # scipy before 1.16 scales what it is given, in place
        loss="huber",
        f_scale=1.345,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    np.testing.assert_allclose(estimate.beta, solved.x / size, rtol=1e-4, atol=1e-5)
    median = [1.4826022185056018 * np.median(np.abs(tau - W @ estimate.beta)) for W, tau in joints]
    np.testing.assert_allclose(estimate.sigma, median, rtol=1e-4)


def test_bisquare_gradient_vanishes(robot, struck):
    model, base, _ = robot
    data = EstimationData(model, accumulate_stream(model, base, [struck]), [struck])
    estimate = methods["bisquare"].estimate(data)
    gradient, size = np.zeros(base.n_base), np.zeros(base.n_base)
    for (W, tau), sigma in zip(full_rows(model, base, struck), estimate.sigma, strict=True):
        r = (tau - W @ estimate.beta) / sigma
        psi = np.where(np.abs(r) < 4.685, r * (1 - (r / 4.685) ** 2) ** 2, 0.0)
        gradient += W.T @ psi / sigma
        size += np.abs(W).T @ np.abs(psi) / sigma
    assert np.max(np.abs(gradient) / size) < 1e-5


def test_collisions_move_robust_fits_much_less(robot, clean, struck):
    model, base, _beta = robot
    errors = {}
    for method in ("wls", "huber", "bisquare", "auto"):
        result = identify_samples(model, struck, drive=DRIVE, base=base, method=method)
        errors[method] = np.linalg.norm(clean.filtered_torque - result.predict(clean).predicted)
        truth_torque = identify_samples(model, clean, drive=DRIVE, base=base)
        errors[method] -= np.linalg.norm(
            clean.filtered_torque - truth_torque.predict(clean).predicted
        )
    assert errors["huber"] < 0.3 * errors["wls"]
    assert errors["bisquare"] < 0.1 * errors["wls"]
    assert errors["auto"] < 0.5 * errors["wls"]


@pytest.mark.study
def test_robust_standard_errors_are_those_of_repeated_experiments(robot):
    model, base, beta = robot
    found, stated = [], []
    for seed in range(30):
        samples = recording(model, base, beta, noise=0.2, seconds=16.0, seed=5)
        rng = np.random.default_rng(seed)
        noise = (
            np.where(rng.random(samples.tau.shape) < 0.05, 10.0, 1.0)
            * rng.normal(size=samples.tau.shape)
            * 0.2
        )
        clean_tau = recording(model, base, beta, noise=0.0, seconds=16.0, seed=5).tau
        spoilt = replace(samples, tau=clean_tau + noise, tau_raw=np.empty((0, 0)), parallel=None)
        estimate = methods["huber"].estimate(
            EstimationData(model, accumulate_stream(model, base, [spoilt]), [spoilt])
        )
        found.append(estimate.beta)
        stated.append(estimate.std_errors)
    ratio = np.std(found, axis=0, ddof=1) / np.mean(stated, axis=0)
    assert 0.85 < np.median(ratio) < 1.15


@pytest.mark.study
def test_they_still_are_where_outliers_sit_where_joints_turn_back(robot):
    model, base, beta = robot
    found, stated = [], []
    clean = recording(model, base, beta, noise=0.0, seconds=16.0, seed=5)
    turning = np.abs(clean.qd) < np.quantile(np.abs(clean.qd), 0.25, axis=0)
    for seed in range(60):
        noise = np.random.default_rng(seed).normal(size=clean.tau.shape) * np.where(
            turning, 4.0, 0.2
        )
        spoilt = replace(clean, tau=clean.tau + noise, tau_raw=np.empty((0, 0)), parallel=None)
        estimate = methods["huber"].estimate(
            EstimationData(model, accumulate_stream(model, base, [spoilt]), [spoilt])
        )
        found.append(estimate.beta)
        stated.append(estimate.std_errors)
    ratio = np.std(found, axis=0, ddof=1) / np.mean(stated, axis=0)
    assert 0.9 < np.median(ratio) < 1.1
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.2


def test_weights_that_did_not_settle_are_said_to_be_the_methods(robot, struck, monkeypatch):
    model, base, _ = robot
    monkeypatch.setattr(robust, "ROBUST", replace(robust.ROBUST, most_iterations=1))
    said = {
        finding.code: finding
        for finding in identify_samples(model, struck, base=base, method="huber").findings
    }
    assert (
        said["not_converged"].message == "The weights of huber had not converged after 1 iterations"
    )
    assert said["not_converged"].cure.settings == {"method": "wls"}
