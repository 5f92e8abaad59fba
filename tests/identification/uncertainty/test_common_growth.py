"""Blocks that follow each other, or are of like motion, share errors of noise and of the model."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve, lfilter

from asbuilt.arrays import Array
from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification import (
    SquareRootInformation,
    TimeBlock,
    estimate_block_uncertainty,
    fit_least_squares,
)
from asbuilt.identification.estimators.held_out_choice import group_different_motions
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.uncertainty.block_scatter import BlockScores
from asbuilt.identification.uncertainty.uncertainty import estimate_scatter

MODEL = load_robot("scara")
BASE = find_base_parameters(MODEL, DriveSet.parse("viscous,offset"))
BETA = np.linspace(1.0, 2.0, BASE.n_base)
RATE = 50.0
MOTION = random_fourier(MODEL, rng=5, duration=120.0, n_harmonics=12)
T = np.arange(0.0, 120.0, 1.0 / RATE)
Q, QD, QDD = MOTION.at(T)
W = observation_matrix(MODEL, Q, QD, QDD, drive=BASE.drive, columns=BASE.columns)
TORQUE = (W @ BETA).reshape(Q.shape)


def merged(errors: list[Array]) -> SquareRootInformation:
    """Return the information of the motion, recorded once for each error."""
    first, *others = [
        accumulate(
            MODEL,
            BASE,
            Samples(T, Q, QD, QDD, TORQUE + error, rate=RATE, joint_names=MODEL.joint_names),
            block_seconds=4.0,
        )
        for error in errors
    ]
    return first.merge(*others)


def fitted(errors: list[Array]) -> tuple[Array, Array]:
    """Return estimates and standard errors."""
    information = merged(errors)
    estimate = fit_least_squares(information, weights=np.ones(MODEL.n_joints))
    return estimate.beta, estimate_block_uncertainty(information, estimate).std_errors


def test_repeated_blocks_are_of_like_motion() -> None:
    noise = np.random.default_rng(0)
    information = merged([noise.normal(size=Q.shape) for _ in range(2)])
    groups = group_different_motions(information, np.ones(MODEL.n_joints))
    assert len(groups) > 1
    assert sorted(np.concatenate(groups).tolist()) == list(range(60))
    for group in groups:
        assert {(b + 30) % 60 for b in group.tolist()} == set(group.tolist())


@pytest.mark.study
def test_variances_under_lasting_noise_are_those_of_dense_matrices() -> None:
    lasting = 1.0
    forget = np.exp(-1.0 / (RATE * lasting))
    columns = W.reshape(len(T), MODEL.n_joints, BASE.n_base)
    correlation = (forget ** np.abs(np.arange(1 - len(T), len(T))))[:, None, None]
    spread = fftconvolve(columns, correlation, axes=0)[len(T) - 1 : 2 * len(T) - 1]
    own = np.linalg.inv(W.T @ W)
    exact = np.diag(own @ np.einsum("tki,tkj->ij", columns, spread) @ own)
    ratios = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        white = rng.normal(size=(len(T) + 1000, MODEL.n_joints))
        noise = lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[1000:]
        information = merged([noise])
        estimate = fit_least_squares(information, weights=np.ones(MODEL.n_joints))
        scatter = estimate_block_uncertainty(information, estimate).scatter
        assert scatter is not None
        ratios.append(np.sum(scatter.moves**2, axis=0) / exact)
    assert 0.9 < float(np.mean(ratios)) < 1.1


def test_an_error_of_the_model_is_no_smaller_after_a_second_recording() -> None:
    lacking = np.sign(np.sin(3.0 * QD)) + np.cos(5.0 * Q)
    _, once = fitted([lacking])
    _, twice = fitted([lacking, lacking])
    assert 0.85 < float(np.median(twice / once)) < 1.2


@pytest.mark.study
def test_intervals_of_a_repeated_motion_keep_their_level_and_have_less_variance() -> None:
    held, ratio = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        noise = [rng.normal(size=Q.shape) for _ in range(3)]
        _, once = fitted(noise[:1])
        beta, thrice = fitted(noise)
        held.append(np.abs(beta - BETA) < 1.96 * thrice)
        ratio.append(thrice / once)
    assert 0.93 < float(np.mean(held)) < 0.985
    assert 0.5 < float(np.median(ratio)) < 0.66


@pytest.mark.study
def test_intervals_hold_what_blocks_of_like_motion_share() -> None:
    """Six motions, each recorded four times at other sizes, with what the model lacks there."""
    t = T[: int(8.0 * RATE)]
    kinds = [random_fourier(MODEL, rng=20 + k, duration=8.0, n_harmonics=4) for k in range(6)]
    waves = np.array([f(2.0 * np.pi * h * t / 8.0) for h in range(1, 9) for f in (np.sin, np.cos)])
    held = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        lacking = [waves.T @ rng.normal(size=(len(waves), MODEL.n_joints)) for _ in kinds]
        parts = []
        for k in range(24):
            q, qd, qdd = ((1.0 + 0.15 * rng.normal()) * x for x in kinds[k % 6].at(t))
            columns = observation_matrix(MODEL, q, qd, qdd, drive=BASE.drive, columns=BASE.columns)
            torque = (columns @ BETA).reshape(q.shape) + lacking[k % 6] + rng.normal(size=q.shape)
            samples = Samples(t, q, qd, qdd, torque, rate=RATE, joint_names=MODEL.joint_names)
            parts.append(accumulate(MODEL, BASE, samples, block_seconds=8.0))
        information = parts[0].merge(*parts[1:])
        estimate = fit_least_squares(information, weights=np.ones(MODEL.n_joints))
        errors = estimate_block_uncertainty(information, estimate).std_errors
        held.append(np.abs(estimate.beta - BETA) < 1.96 * errors)
    assert 0.85 < float(np.mean(held)) < 0.97, "0.74 if only successive blocks and repeats count"


def test_what_repetitions_share_is_told_from_noise() -> None:
    lacking, rng = np.sign(np.sin(3.0 * QD)) + np.cos(5.0 * Q), np.random.default_rng(0)
    shared = []
    for errors in ([lacking] * 2, [rng.normal(size=Q.shape) for _ in range(2)]):
        information = merged(errors)
        estimate = fit_least_squares(information, weights=np.ones(MODEL.n_joints))
        shared.append(estimate_block_uncertainty(information, estimate).shared)
    assert 1.5 < shared[0] < 3.0
    assert 1.0 <= shared[1] < 1.1


def test_variances_allow_for_nuisance_that_absorbs_lasting_residuals() -> None:
    """One unknown beside twelve others: ten blocks of a second, noise that lasts a third of one.

    The scatter of its own projected score alone is too small: the others absorb the residual too.
    """
    rng, n, p, blocks = np.random.default_rng(3), 500, 13, 10
    t = np.arange(n) / 50.0
    columns = [np.sin(2.0 * np.pi * f * t + rng.uniform(0, 6)) for f in rng.uniform(0.1, 2.0, p)]
    A = np.column_stack(columns)
    root = np.linalg.inv(np.linalg.cholesky(A.T @ A)).T
    cut = np.split(np.arange(n), blocks)
    grams = np.array([(A[rows] @ root).T @ (A[rows] @ root) for rows in cut])
    times = [TimeBlock("log", t[rows[0]], t[rows[-1]], len(rows)) for rows in cut]
    alone, whole = [], []
    for _ in range(400):
        white = rng.normal(size=n + 100)
        noise = lfilter([0.35], [1.0, -0.94], white)[100:]
        error = noise - A @ root @ (root.T @ (A.T @ noise))
        scores = np.array([(A[rows] @ root).T @ error[rows] for rows in cut])
        data = BlockScores(grams, scores, times, [np.arange(blocks)], n, float(error @ error) / n)
        off = float((root @ (root.T @ (A.T @ noise)))[-1])
        whole.append(abs(off) < 1.96 * np.sqrt(estimate_scatter(data, root[-1:]).variance[0]))
        own = float(np.sum((scores @ root[-1]) ** 2)) * blocks / (blocks - 1)
        alone.append(abs(off) < 1.96 * np.sqrt(own))
    assert np.mean(alone) < 0.9
    assert 0.93 < np.mean(whole) < 1.0
