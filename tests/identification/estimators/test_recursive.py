"""The recursive estimate against all samples at once, and a load that changes."""

from __future__ import annotations

import numpy as np
import pytest
from three_links import DRIVE, recording, truth

from asbuilt.description import LinkInertia
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import VirtualRobot
from asbuilt.identification import RecursiveIdentification, fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate


def fed(line, samples, start=0, stop=None):
    answer = None
    for i in range(start, len(samples.t) if stop is None else stop):
        answer = line.update(samples.q[i], samples.qd[i], samples.qdd[i], samples.tau[i])
    return answer


def test_without_forgetting_it_is_least_squares_of_all_samples(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.3, parallel=False)
    weights = [1.0, 0.5, 2.0]
    batch = fit_least_squares(accumulate(model, base, samples), weights=weights)
    answer = fed(RecursiveIdentification(model, base, weights=weights), samples)
    np.testing.assert_allclose(answer.beta, batch.beta, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(answer.std_errors, batch.std_errors, rtol=1e-9)
    assert answer.rank == base.n_base


def test_forgetting_is_a_weight_that_decays(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.3, seconds=10.0, parallel=False)
    from asbuilt.dynamics import observation_matrix

    W = observation_matrix(
        model, samples.q, samples.qd, samples.qdd, drive=DRIVE, columns=base.columns
    )
    w = np.repeat(0.99 ** (0.5 * np.arange(len(samples.t))[::-1]), 3)
    direct = np.linalg.lstsq(W * w[:, None], samples.tau.ravel() * w, rcond=None)[0]
    answer = fed(RecursiveIdentification(model, base, forgetting=0.99), samples)
    np.testing.assert_allclose(answer.beta, direct, rtol=1e-7, atol=1e-7)
    assert answer.n_effective == pytest.approx((1 - 0.99 ** len(samples.t)) / 0.01)


@pytest.mark.study
def test_load_that_is_picked_up_is_followed(robot):
    model, base, beta = robot
    tool = LinkInertia.from_com(1.5, [0.05, 0.0, 0.1], np.diag([0.01, 0.01, 0.005]))
    heavier = VirtualRobot.ideal(model).with_tool(tool).model
    loaded = truth(base, heavier)
    empty, full = (
        recording(model, base, b, noise=0.1, seconds=30.0, seed=3, parallel=False)
        for b in (beta, loaded)
    )
    line, stubborn = (RecursiveIdentification(model, base, forgetting=f) for f in (0.995, 1.0))
    before = fed(line, empty)
    fed(stubborn, empty)
    after, average = fed(line, full), fed(stubborn, full)
    moved = np.linalg.norm(loaded - beta)
    assert np.linalg.norm(before.beta - beta) < 0.2 * moved
    assert np.linalg.norm(after.beta - loaded) < 0.2 * moved
    assert np.linalg.norm(average.beta - loaded) > 0.3 * moved


@pytest.mark.study
def test_standing_still_loses_nothing_with_a_prior(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.1, seconds=10.0, parallel=False)
    line = RecursiveIdentification(model, base, forgetting=0.98, prior=beta, prior_strength=1.0)
    fed(line, samples)
    q, still = samples.q[0], np.zeros(3)
    for _ in range(3000):
        answer = line.update(q, still, still, samples.tau[0])
    assert np.all(np.isfinite(answer.beta))
    assert np.linalg.norm(answer.beta - beta) < np.linalg.norm(beta)


def test_first_sample_leans_on_the_prior(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, seconds=1.0, parallel=False)
    line = RecursiveIdentification(model, base, prior=beta)
    answer = line.update(samples.q[0], samples.qd[0], samples.qdd[0], samples.tau[0])
    assert answer.rank == 3
    np.testing.assert_allclose(answer.beta, beta, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"forgetting": 0.0}, "forgetting factor"),
        ({"forgetting": 1.1}, "forgetting factor"),
        ({"weights": [1.0, 2.0]}, "weights must be 3"),
        ({"prior": [1.0]}, "base parameters"),
        ({"prior_strength": -1.0}, "not negative, got -1"),
        ({"prior_strength": float("nan")}, "not negative, got nan"),
    ],
)
def test_options_are_checked(robot, options, message):
    model, base, _ = robot
    with pytest.raises(UsageError, match=message):
        RecursiveIdentification(model, base, **options)


def test_samples_are_checked(robot):
    model, base, _ = robot
    line = RecursiveIdentification(model, base)
    with pytest.raises(UsageError, match="3 values each"):
        line.update([0.0] * 2, [0.0] * 3, [0.0] * 3, [0.0] * 3)
    with pytest.raises(IdentifiabilityError, match="NaN"):
        line.update([0.0] * 3, [0.0] * 3, [0.0] * 3, [np.nan] * 3)
