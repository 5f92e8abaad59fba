"""Errors from the scatter of whole recordings against the scatter of one fit for each."""

from __future__ import annotations

import numpy as np
import pytest
from tests.identification.uncertainty.test_common_growth import (
    BASE,
    MODEL,
    QD,
    QDD,
    RATE,
    TORQUE,
    Q,
    T,
    W,
)

from asbuilt.experiment import Samples
from asbuilt.identification import (
    SquareRootInformation,
    estimate_block_uncertainty,
    fit_least_squares,
    widening,
)
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.uncertainty.uncertainty import estimate_recording_variances

WEIGHTS = np.ones(MODEL.n_joints)


@pytest.fixture(scope="module")
def recordings() -> list[SquareRootInformation]:
    """One motion recorded six times, each time by a robot with parameters of its own."""
    rng, found = np.random.default_rng(3), []
    for number in range(6):
        moved = (W @ (0.1 * rng.normal(size=BASE.n_base))).reshape(Q.shape)
        tau = TORQUE + moved + 0.01 * rng.normal(size=Q.shape)
        samples = Samples(
            T, Q, QD, QDD, tau, rate=RATE, joint_names=MODEL.joint_names, source=f"log {number}"
        )
        found.append(accumulate(MODEL, BASE, samples, block_seconds=4.0))
    return found


def test_variance_is_that_of_the_mean_of_a_fit_to_each_recording(
    recordings: list[SquareRootInformation],
) -> None:
    first, *others = recordings
    information = first.merge(*others)
    estimate = fit_least_squares(information, weights=WEIGHTS)
    alone = np.array([fit_least_squares(each, weights=WEIGHTS).beta for each in recordings])
    assert estimate.beta == pytest.approx(alone.mean(axis=0), rel=1e-6)
    expected = alone.var(axis=0, ddof=1) / len(alone) * widening(np.array(len(alone) - 1.0)) ** 2
    assert estimate_recording_variances(information, estimate) == pytest.approx(expected, rel=1e-6)


def test_few_recordings_say_nothing(recordings: list[SquareRootInformation]) -> None:
    information = recordings[0].merge(*recordings[1:3])
    estimate = fit_least_squares(information, weights=WEIGHTS)
    assert not np.any(estimate_recording_variances(information, estimate))
    assert np.all(estimate_block_uncertainty(information, estimate).std_errors > 0.0)
