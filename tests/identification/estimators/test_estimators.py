"""One contract for every estimator: what holds whatever it minimises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from three_links import DRIVE, arm, recording

from asbuilt.dynamics import find_base_parameters
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import Samples
from asbuilt.identification import IdentificationResult, identify_samples, methods, summarise

every_method = pytest.mark.parametrize("method", list(methods))


@pytest.fixture(scope="module")
def noisy(robot):
    model, base, beta = robot
    return [
        recording(model, base, beta, noise=0.3, seed=seed, source=f"run {seed}") for seed in (1, 2)
    ]


@pytest.fixture(scope="module")
def found(robot, noisy):
    """What every estimator finds from the noisy recordings."""
    model, base, _ = robot
    return {
        name: identify_samples(model, noisy, drive=DRIVE, base=base, method=name)
        for name in methods
    }


@every_method
def test_without_noise_it_finds_the_truth(robot, method):
    model, base, beta = robot
    result = identify_samples(
        model, recording(model, base, beta), drive=DRIVE, base=base, method=method
    )
    assert result.train.relative_error < 1e-5
    np.testing.assert_allclose(result.estimates, beta, rtol=0, atol=2e-4 * np.abs(beta).max())


@every_method
def test_with_noise_errors_cover_the_truth(robot, found, method):
    _, _, beta = robot
    result = found[method]
    told = result.std_errors > 0
    assert np.mean(np.abs(result.estimates - beta)[told] < 4 * result.std_errors[told]) > 0.9
    assert result.train.relative_error < 0.1
    assert np.all(result.sigma > 0)


@every_method
def test_torques_in_other_units_scale_the_estimate(robot, noisy, found, method):
    _, _, _ = robot
    tenfold = arm(10.0)
    batches = [
        replace(samples, tau=10 * samples.tau, tau_raw=np.empty((0, 0))) for samples in noisy
    ]
    result = identify_samples(tenfold, batches, drive=DRIVE, method=method)
    size = np.abs(found[method].estimates).max()
    np.testing.assert_allclose(
        result.estimates / 10, found[method].estimates, rtol=0, atol=1e-3 * size
    )
    np.testing.assert_allclose(result.sigma / 10, found[method].sigma, rtol=1e-3)


@every_method
def test_order_of_recordings_does_not_matter(robot, noisy, found, method):
    model, base, _ = robot
    result = identify_samples(model, noisy[::-1], drive=DRIVE, base=base, method=method)
    size = np.abs(found[method].estimates).max()
    np.testing.assert_allclose(result.estimates, found[method].estimates, rtol=0, atol=1e-5 * size)
    np.testing.assert_allclose(
        result.std_errors, found[method].std_errors, rtol=1e-2, atol=1e-6 * size
    )


@every_method
def test_same_data_give_the_same_bits(robot, noisy, found, method):
    model, base, _ = robot
    again = identify_samples(model, noisy, drive=DRIVE, base=base, method=method)
    assert again.to_json() == found[method].to_json()


@every_method
def test_result_survives_storage_and_says_its_method(found, method):
    result = found[method]
    assert IdentificationResult.from_json(result.to_json()).to_json() == result.to_json()
    assert method in (result.method, "auto")
    assert methods[result.method].title in summarise(result).as_text().splitlines()[0]
    text = " ".join(summarise(result).as_text(full=True).split())
    for note in result.notes:
        assert note in text


@every_method
def test_joint_that_stands_still_is_named_or_refused(robot, method):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.1, still=(2,), seed=4)
    result = identify_samples(model, samples, drive=DRIVE, base=base, method=method)
    assert result.rank < result.n_base
    assert any("Fv3" in text for text in result.undetermined)
    assert np.all(np.isfinite(result.estimates))
    with pytest.raises(IdentifiabilityError, match="Fv3"):
        identify_samples(
            model, samples, drive=DRIVE, base=base, method=method, undetermined="refuse"
        )


@every_method
def test_too_few_samples_are_refused(robot, method):
    model, base, beta = robot
    few = recording(model, base, beta, seconds=0.1, parallel=False)
    with pytest.raises(IdentifiabilityError, match="too few"):
        identify_samples(model, few, drive=DRIVE, base=base, method=method)


@every_method
@pytest.mark.parametrize("errors", ["blocks", "bootstrap"])
def test_rest_without_gravity_tells_nothing_and_is_said_so(method, errors):
    """No torque depends on any parameter: rank 0, and everything stays where CAD has it."""
    model = arm().with_gravity([0.0, 0.0, 0.0])
    base = find_base_parameters(model)
    still = np.zeros((600, 3))
    samples = Samples(
        np.arange(600) / 50.0,
        still,
        still,
        still,
        0.1 * np.random.default_rng(0).normal(size=(600, 3)),
        rate=50.0,
        joint_names=model.joint_names,
    )
    result = identify_samples(model, samples, base=base, method=method, errors=errors)
    assert result.rank == 0
    assert len(result.undetermined) == base.n_base
    assert np.all(np.isfinite(result.estimates))


def test_unknown_method_is_answered_with_the_list():
    with pytest.raises(UsageError, match=r"'owls'.*available: .*huber"):
        methods.find("owls")


@every_method
def test_every_method_says_what_it_is(method):
    entry = methods[method]
    assert entry.name == method
    assert entry.title
    assert entry.description
    assert not entry.description.endswith(".")
    assert entry.needs in ("information", "samples", "simulation")
