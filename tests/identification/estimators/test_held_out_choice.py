"""The choice of the weight of CAD against folds reduced from their blocks and errors summed over
the rows themselves.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import sem
from three_links import full_rows, recording

from asbuilt.identification.estimators.held_out_choice import DEFAULT_WEIGHT, choose_weight
from asbuilt.identification.information.square_root_information import accumulate


def test_errors_are_those_of_the_rows_held_out(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=1.0, seconds=40.0, seed=5)
    information = accumulate(model, base, samples, block_seconds=5.0)
    assert information.n_blocks == 8
    weights = np.array([1.0, 0.5, 2.0])

    def fits(factors, weight):
        shrunk = [
            np.linalg.lstsq(factor[:-1, :-1], factor[:-1, -1] / (1.0 + weight), rcond=None)[0]
            for factor in factors
        ]
        return np.array(shrunk) @ np.linalg.pinv(base.regrouping).T

    choice = choose_weight(information, weights, base.regrouping, fits, (1.0, 1e-2, 1e-4))
    joints = full_rows(model, base, samples)
    ends = np.cumsum([block.n_samples for block in information.blocks])[:-1]
    parts = [list(zip(np.split(W, ends), np.split(tau, ends), strict=True)) for W, tau in joints]
    for row, weight in enumerate((1.0, 1e-2, 1e-4)):
        for held in range(8):
            W, tau = (
                np.concatenate(
                    [
                        w * joint[b][part]
                        for w, joint in zip(weights, parts, strict=True)
                        for b in range(8)
                        if b != held
                    ]
                )
                for part in (0, 1)
            )
            found = np.linalg.lstsq(W, tau / (1.0 + weight), rcond=None)[0]
            errors = [
                w * (joint[held][1] - joint[held][0] @ found)
                for w, joint in zip(weights, parts, strict=True)
            ]
            np.testing.assert_allclose(
                choice.errors[row, held], np.mean(np.square(errors)), rtol=1e-6
            )
    means, best = choice.errors.mean(axis=1), choice.errors.mean(axis=1).argmin()
    excess = choice.errors - choice.errors[best]
    near = [means[row] - means[best] <= sem(excess[row]) for row in range(3)]
    assert choice.weight == (1.0, 1e-2, 1e-4)[near.index(True)]


def test_few_blocks_take_the_default(robot):
    model, base, beta = robot
    information = accumulate(
        model, base, recording(model, base, beta, noise=1.0, seconds=8.0, seed=5), block_seconds=4.0
    )
    assert (
        choose_weight(information, np.ones(3), base.regrouping, lambda *_: np.zeros(0)).weight
        == DEFAULT_WEIGHT
    )
