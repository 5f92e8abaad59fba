"""Standard errors include the bias by effects that are named, and hold the truth with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.catalogue import bundled_robot
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.errors.block_scatter import widening
from asbuilt.identification.errors.error_basis import ErrorKind
from asbuilt.identification.identify import Fit, fit_samples, identify_samples
from asbuilt.validation.comparison.equal_terms import Between, ComparedValues
from asbuilt.validation.generalisation.effect_bias import with_effects
from asbuilt.validation.generalisation.missing_effects import TILT, MissingEffect
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.study import identify

MODEL = bundled_robot("two-link")
FITTED = DriveSet.parse("viscous,coulomb,offset")
RICHER = DriveSet.parse("viscous,coulomb,quadratic,offset")
STRIBECK = DriveSet.parse("viscous,coulomb,stribeck:velocity=0.1,offset")
SHOWN = tuple(MissingEffect("quadratic", name, 20.0, 0.0) for name in MODEL.joint_names)


def samples(seed: int = 0, drive: DriveSet = RICHER, further: float = 0.2) -> Samples:
    """Return samples of a robot with some further friction."""
    values = np.tile([1.0, 1.0, further, 0.3], 2)
    machine = VirtualRobot.ideal(MODEL).with_drive(drive, values)
    log = machine.record(random_fourier(MODEL, rng=3, duration=30.0), rate=100.0).recording
    noise = 0.02 * np.random.default_rng(seed).normal(size=log.tau.shape)
    return prepare_samples(replace(log, tau=log.tau + noise, qd=None, qdd=None))


def fitted(data: Samples, method: str = "wls", errors: ErrorKind = "blocks") -> Fit:
    """Return a fit without the quadratic friction."""
    return fit_samples(MODEL, [data], drive=FITTED, method=method, errors=errors)


def test_the_bias_is_the_difference_of_fits_without_and_with_the_effect() -> None:
    data = samples()
    found = with_effects(fitted(data), [data], SHOWN).omitted
    assert found is not None
    short, full = (identify_samples(MODEL, data, drive=drive) for drive in (FITTED, RICHER))
    values = dict(zip(full.base.names, full.estimates, strict=True))
    bias = np.array(
        [
            value - values[name]
            for name, value in zip(short.base.names, short.estimates, strict=True)
        ]
    )
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance)), np.abs(bias), rtol=0.05, atol=2e-3
    )
    assert np.any(np.abs(bias) > 5.0 * short.std_errors)


def test_the_bias_by_a_tilt_is_that_of_the_fit_on_the_tilted_base() -> None:
    model = bundled_robot("ur10e")
    turned = Rotation.from_rotvec(np.deg2rad([2.0, 0.0, 0.0])).apply(np.array(model.gravity))
    machine = VirtualRobot.ideal(model.with_gravity(turned))
    log = machine.record(random_fourier(model, rng=3, duration=30.0), rate=100.0).recording
    noise = 0.01 * np.random.default_rng(2).normal(size=log.tau.shape)
    data = prepare_samples(replace(log, tau=log.tau + noise, qd=None, qdd=None))
    fit = fit_samples(model, [data])
    found = with_effects(fit, [data], (MissingEffect(TILT, None, 20.0, 0.0),)).omitted
    assert found is not None
    tilted = identify_samples(model.with_gravity(turned), data)
    values = dict(zip(tilted.base.names, tilted.estimates, strict=True))
    bias = fit.estimate.beta - np.array([values[name] for name in fit.base.names])
    large = np.abs(bias) > 0.2 * np.abs(bias).max()
    sizes: Array = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sizes[large], np.abs(bias)[large], rtol=0.1)


@pytest.mark.parametrize("method", ["wls", "consistent"])
def test_without_effects_and_with_textbook_errors_nothing_is_added(method: str) -> None:
    data = samples()
    assert with_effects(fitted(data, method), [data], ()).omitted is None
    assert with_effects(fitted(data, method, "textbook"), [data], SHOWN).omitted is None


@pytest.mark.study
def test_intervals_hold_the_truth_under_friction_that_the_model_lacks() -> None:
    truth = np.concatenate(
        [
            np.concatenate([link.inertia.parameters for link in MODEL.links]),
            np.tile([1.0, 1.0, 0.3], 2),
        ]
    )
    held, narrow = [], []
    for seed in range(6):
        data = samples(seed, STRIBECK, 0.5)
        options = StudyOptions(drive=FITTED, method="wls", checked=False)
        study = identify(MODEL, data, options=options)
        assert "missing_effect" in {each.code for each in study.findings}
        error = np.abs(study.result.estimates - study.result.base.values(truth))
        held.append(error < 1.96 * study.result.std_errors)
        narrow.append(error < 1.96 * fitted(data).uncertainty.std_errors)
        assert "bias by effects that the model lacks" in " ".join(study.result.notes)
        finding = next(each for each in study.findings if each.code == "missing_effect")
        assert "Standard errors include their bias" in finding.message
    assert np.mean(held) >= 0.93
    assert np.mean(narrow) < 0.8


def test_the_bias_that_two_results_share_is_no_error_of_their_difference() -> None:
    pair = [
        with_effects(fit, [data], SHOWN).concluded(*fit.metrics([data]))
        for data in (samples(1), samples(2))
        for fit in (fitted(data),)
    ]
    one, two = ComparedValues.own(pair[0]), ComparedValues.own(pair[1])
    places = list(range(len(one.estimates)))
    between = Between(one, two, places, places)
    alone = np.hypot(one.std_errors, two.std_errors)
    plain = [
        ComparedValues.own(identify_samples(MODEL, data, drive=FITTED))
        for data in (samples(1), samples(2))
    ]
    scatter = Between(*plain, places, places).std_errors
    biased = alone > 3.0 * scatter
    assert np.sum(biased) >= 3
    assert np.all(between.std_errors[biased] < 0.5 * alone[biased])
    assert np.all(between.std_errors > 0.99 * scatter)
    swapped = Between(two, one, places, places)
    np.testing.assert_allclose(swapped.std_errors, between.std_errors, rtol=1e-12)
    test = between.test(np.ones(len(places), dtype=np.bool_))
    assert 0.001 < test.probability < 0.999
    assert test.degrees == len(places)
    narrow = between.std_errors / widening(between.degrees_of_freedom)
    np.testing.assert_allclose(np.sqrt(np.diag(between.covariance)), narrow, rtol=1e-6)
