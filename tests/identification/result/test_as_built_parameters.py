"""The robot closest to CAD within the noise of the torques, checked against predicted torques."""

from __future__ import annotations

import numpy as np
import pytest
from three_links import DRIVE, recording

from asbuilt.description.inertia import pseudo_inertias
from asbuilt.identification import as_built_parameters, build_cad_prior, identify_samples
from asbuilt.identification.bodies.entropic_fit import Coordinates
from asbuilt.identification.bodies.standard_parameters import LIMIT, find_standard_parameters
from asbuilt.validation.prediction import predict_both


@pytest.fixture(scope="module")
def samples(robot):
    model, base, beta = robot
    return recording(model, base, beta, noise=0.3, seconds=60.0, seed=2)


@pytest.fixture(scope="module")
def result(robot, samples):
    model, base, _ = robot
    return identify_samples(model, samples, drive=DRIVE, base=base, method="consistent")


def test_closest_to_cad_within_the_noise_of_the_torques(result, samples):
    found = as_built_parameters(result)
    cad = build_cad_prior(result.model, DRIVE)
    exact = find_standard_parameters(result.model, result.base, result.estimates)
    kept = result.base.values(found.parameters)
    predicted = predict_both(result.model, result.base, result.estimates, kept, samples)
    moved = (predicted.predicted - predicted.predicted_cad) / result.sigma
    chi_square = np.sum(moved**2)
    # The weak belief in CAD, which held the fit where torques are silent, is in the metric too.
    assert 0.9 * LIMIT < chi_square <= found.chi_square <= LIMIT
    assert np.all(np.abs(kept - result.estimates) <= np.sqrt(np.diag(result.covariance)))
    assert cad.divergence(found.parameters).sum() < cad.divergence(exact.parameters).sum()
    assert np.linalg.eigvalsh(pseudo_inertias(found.parameters[:30].reshape(-1, 10))).min() > 0.0
    assert "within the noise of the data used" in found.verdict
    assert not found.substituted


def test_no_parameters_with_these_torques_or_nearer_ones_are_closer(result):
    found = as_built_parameters(result)
    cad = build_cad_prior(result.model, DRIVE)
    exact = find_standard_parameters(result.model, result.base, result.estimates).parameters
    same_torque = Coordinates.of(result.base).dependent
    rng = np.random.default_rng(0)
    least = cad.divergence(found.parameters).sum()
    for size in (1e-3, 1e-2, 1e-1):
        for _ in range(40):
            step = same_torque @ rng.normal(size=same_torque.shape[1])
            step *= size * np.linalg.norm(found.parameters) / np.linalg.norm(step)
            inward = rng.uniform(0.0, 0.1) * (exact - found.parameters)
            assert cad.divergence(found.parameters + step + inward).sum() >= least * (1.0 - 1e-3)


def test_exported_torques_stay_within_their_noise(robot, result):
    model, base, beta = robot
    other = recording(model, base, beta, seconds=20.0, seed=9)
    found = as_built_parameters(result)
    one, two = (
        predict_both(model, base, values, values, other).predicted
        for values in (result.estimates, found.beta)
    )
    assert np.sqrt(np.mean((one - two) ** 2)) < 0.1 * np.sqrt(np.mean(one**2))
