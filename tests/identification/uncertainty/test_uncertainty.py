"""Standard errors by repeated experiments with noise that is white, and noise that is not."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.experiment import Samples
from asbuilt.identification import estimate_block_uncertainty, fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.uncertainty.uncertainty import FEWEST_BLOCKS

RATE = 50.0
BLOCKS = 40


@pytest.fixture(scope="module")
def experiment():
    """A smooth motion of 80 s of a two-link arm, its observation matrix and true parameters."""
    model = load_robot("scara")
    base = find_base_parameters(model, DriveSet.parse("viscous,offset"))
    n, t = model.n_joints, np.arange(0.0, 80.0, 1 / RATE)
    rng = np.random.default_rng(5)
    frequency, phase = rng.uniform(0.3, 3.0, (5, 1, n)), rng.uniform(0, 6.0, (5, 1, n))
    angle = 2 * np.pi * frequency * t[:, None] + phase
    q = np.sum(0.2 * np.sin(angle), axis=0)
    qd = np.sum(0.2 * 2 * np.pi * frequency * np.cos(angle), axis=0)
    qdd = -np.sum(0.2 * (2 * np.pi * frequency) ** 2 * np.sin(angle), axis=0)
    w = observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)
    beta = np.linspace(1.0, 2.0, base.n_base)
    return model, base, t, q, qd, qdd, w, beta


def scatter(experiment, noise, repetitions, block_seconds):
    model, base, t, q, qd, qdd, w, beta = experiment
    honest, textbook, effective = [], [], []
    for seed in range(repetitions):
        tau = (w @ beta).reshape(q.shape) + noise(np.random.default_rng(seed), q.shape)
        samples = Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names)
        information = accumulate(model, base, samples, block_seconds=block_seconds)
        estimate = fit_least_squares(information, weights="joint")
        uncertainty = estimate_block_uncertainty(information, estimate)
        honest.append((estimate.beta - beta) / uncertainty.std_errors)
        textbook.append((estimate.beta - beta) / estimate.std_errors)
        effective.append(uncertainty.effective_samples)
    return np.array(honest), np.array(textbook), np.array(effective)


def white(rng, shape):
    return rng.normal(size=shape)


def coloured(rng, shape, keep=0.9):
    e = rng.normal(size=shape)
    for i in range(1, len(e)):
        e[i] += keep * e[i - 1]
    return e


@pytest.mark.study
def test_white_noise_leaves_the_textbook_error_about_as_it_is(experiment):
    honest, textbook, effective = scatter(experiment, white, 30, 80.0 / BLOCKS)
    assert np.mean(textbook**2) == pytest.approx(1.0, abs=0.25)
    assert 0.6 < np.mean(honest**2) < 1.1
    assert np.all(effective <= len(experiment[2]))
    assert effective.mean() > 0.6 * len(experiment[2])


@pytest.mark.study
def test_coloured_noise_makes_the_textbook_error_too_small_but_not_the_honest_one(experiment):
    honest, textbook, effective = scatter(experiment, coloured, 30, 80.0 / BLOCKS)
    assert np.mean(textbook**2) > 2.0
    assert 0.6 < np.mean(honest**2) < 1.5
    assert np.mean(np.abs(honest) < 1.96) > 0.9
    assert effective.mean() < 0.5 * len(experiment[2])


def test_no_error_is_smaller_than_the_textbook_one_and_correlations_are_kept(experiment):
    model, base, t, q, qd, qdd, w, beta = experiment
    tau = (w @ beta).reshape(q.shape) + coloured(np.random.default_rng(1), q.shape)
    information = accumulate(
        model, base, Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names)
    )
    estimate = fit_least_squares(information, weights="joint")
    uncertainty = estimate_block_uncertainty(information, estimate)
    assert uncertainty.basis.kind == "blocks"
    assert np.all(uncertainty.std_errors >= estimate.std_errors * (1 - 1e-12))
    one = estimate.covariance / np.outer(estimate.std_errors, estimate.std_errors)
    other = uncertainty.covariance / np.outer(uncertainty.std_errors, uncertainty.std_errors)
    assert np.allclose(one, other)


def test_too_few_blocks_fall_back_to_the_textbook(experiment):
    model, base, t, q, qd, qdd, w, beta = experiment
    tau = (w @ beta).reshape(q.shape) + white(np.random.default_rng(1), q.shape)
    samples = Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names)
    information = accumulate(model, base, samples, block_seconds=80.0 / (FEWEST_BLOCKS - 1))
    uncertainty = estimate_block_uncertainty(information, fit_least_squares(information))
    assert uncertainty.basis.kind == "textbook"
    assert uncertainty.effective_samples == len(t)
    assert (uncertainty.basis.asked, uncertainty.basis.n_blocks, uncertainty.basis.growth) == (
        "blocks",
        FEWEST_BLOCKS - 1,
        None,
    )
    assert "7 time blocks are too few to correct this" in uncertainty.basis.sentence(
        uncertainty.effective_samples, len(t)
    )
