"""A motion that is repeated shows the noise again, but no more of what the model lacks."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.errors.common_growth import repetitions
from asbuilt.identification.errors.uncertainty import block_scores, block_uncertainty
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate

MODEL = load_robot("scara")
BASE = find_base_parameters(MODEL, DriveSet.parse("viscous,offset"))
BETA = np.linspace(1.0, 2.0, BASE.n_base)
RATE = 50.0
MOTION = random_fourier(MODEL, rng=5, duration=120.0, n_harmonics=12)
T = np.arange(0.0, 120.0, 1.0 / RATE)
Q, QD, QDD = MOTION.at(T)
TORQUE = (
    observation_matrix(MODEL, Q, QD, QDD, drive=BASE.drive, columns=BASE.columns) @ BETA
).reshape(Q.shape)


def fitted(errors: list[Array]) -> tuple[Array, Array, set[tuple[int, int]]]:
    """Return estimates, standard errors and repeated blocks of the motion, once for each error."""
    information = [
        accumulate(
            MODEL,
            BASE,
            Samples(T, Q, QD, QDD, TORQUE + error, rate=RATE, joint_names=MODEL.joint_names),
            block_seconds=4.0,
        )
        for error in errors
    ]
    merged = information[0].merge(*information[1:])
    estimate = fit_least_squares(merged, weights=np.ones(MODEL.n_joints))
    grams, _ = block_scores(merged, estimate)
    return estimate.beta, block_uncertainty(merged, estimate).std_errors, repetitions(merged, grams)


def test_repeated_blocks_are_those_of_the_same_motion() -> None:
    noise = np.random.default_rng(0)
    assert not fitted([noise.normal(size=Q.shape)])[2]
    found = fitted([noise.normal(size=Q.shape) for _ in range(2)])[2]
    assert found == {(b, b + 30) for b in range(30)}


def test_an_error_of_the_model_is_no_smaller_after_a_second_recording() -> None:
    lacking = np.sign(np.sin(3.0 * QD)) + np.cos(5.0 * Q)
    _, once, _ = fitted([lacking])
    _, twice, _ = fitted([lacking, lacking])
    assert 0.85 < float(np.median(twice / once)) < 1.2


def test_intervals_of_a_repeated_motion_keep_their_level_and_have_less_variance() -> None:
    held, ratio = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noise = [rng.normal(size=Q.shape) for _ in range(3)]
        _, once, _ = fitted(noise[:1])
        beta, thrice, _ = fitted(noise)
        held.append(np.abs(beta - BETA) < 1.96 * thrice)
        ratio.append(thrice / once)
    assert 0.93 < float(np.mean(held)) < 0.985
    assert 0.5 < float(np.median(ratio)) < 0.66
