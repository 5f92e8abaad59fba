"""Standard errors include the bias by effects that are named, and hold the truth with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples, VirtualRobot, prepare_samples
from asbuilt.identification import find_effects, identify_samples, widening
from asbuilt.identification.identify import Fit, fit_samples
from asbuilt.identification.uncertainty.error_kinds import ErrorKind
from asbuilt.validation.comparison.equal_terms import Between, ComparedValues
from asbuilt.workflow import StudyOptions, identify

MODEL = bundled_robot("two-link")
FITTED = DriveSet.parse("viscous,coulomb,offset")
RICHER = DriveSet.parse("viscous,coulomb,quadratic,offset")
STRIBECK = DriveSet.parse("viscous,coulomb,stribeck:velocity=0.1,offset")


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


def with_lacking(fit: Fit, data: Samples) -> Fit:
    """Return a fit with the bias by what the samples show, with no effect in its model."""
    found = find_effects(fit.model, fit.base.drive, [data], applied=())
    assert found.lacking is not None
    return replace(fit, omitted=found.lacking.bias(fit))


def test_the_bias_is_the_difference_of_fits_without_and_with_the_effect() -> None:
    data = samples()
    found = with_lacking(fitted(data), data).omitted
    assert found is not None
    assert "quadratic friction at joint_1 and joint_2" in found.sentence
    short, full = (identify_samples(MODEL, data, drive=drive) for drive in (FITTED, RICHER))
    values = dict(zip(full.base.names, full.estimates, strict=True))
    bias = np.array(
        [
            value - values[name]
            for name, value in zip(short.base.names, short.estimates, strict=True)
        ]
    )
    sizes = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sizes, np.abs(bias), rtol=0.05, atol=2e-3)
    assert np.any(np.abs(bias) > 5.0 * short.std_errors)


@pytest.mark.study
def test_the_bias_by_a_tilt_is_that_of_the_fit_on_the_tilted_base() -> None:
    model = bundled_robot("ur10e")
    turned = Rotation.from_rotvec(np.deg2rad([2.0, 0.0, 0.0])).apply(np.array(model.gravity))
    machine = VirtualRobot.ideal(model.with_gravity(turned))
    log = machine.record(random_fourier(model, rng=3, duration=30.0), rate=100.0).recording
    noise = 0.01 * np.random.default_rng(2).normal(size=log.tau.shape)
    data = prepare_samples(replace(log, tau=log.tau + noise, qd=None, qdd=None))
    fit = fit_samples(model, [data])
    found = with_lacking(fit, data).omitted
    assert found is not None
    assert "base tilt" in found.effects
    tilted = identify_samples(model.with_gravity(turned), data)
    values = dict(zip(tilted.base.names, tilted.estimates, strict=True))
    bias = fit.estimate.beta - np.array([values[name] for name in fit.base.names])
    large = np.abs(bias) > 0.2 * np.abs(bias).max()
    sizes: Array = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sizes[large], np.abs(bias)[large], rtol=0.1)


def test_textbook_errors_stay_and_a_right_model_lacks_at_most_a_level_floor() -> None:
    data = samples()
    lacking = find_effects(MODEL, FITTED, [data], applied=()).lacking
    assert lacking is not None
    assert lacking.bias(fitted(data, errors="textbook")) is None
    right = find_effects(MODEL, RICHER, [data], applied=()).lacking
    assert right is not None
    assert right.sizes.tolist() == [np.deg2rad(0.5)] * len(right.columns)
    # Gravity turns about joint 1, which no torque of it shows: the floor is found level.
    assert np.all(np.abs(right.values) < 4.0 * np.sqrt(np.diag(right.covariance)) + 1e-9)


@pytest.mark.study
def test_the_error_of_a_tilt_in_the_model_is_that_of_the_parameters_too() -> None:
    """Parameters scatter over noise by the part of a tilt that every log finds anew."""
    model, drive = bundled_robot("scara"), DriveSet.parse("viscous,coulomb,offset")
    turned = Rotation.from_rotvec(np.deg2rad([2.0, 1.0, 0.0])).apply(np.array(model.gravity))
    machine = VirtualRobot.ideal(model.with_gravity(turned))
    log = machine.record(random_fourier(model, rng=3, duration=30.0), rate=100.0).recording
    values, stated, alone = [], [], []
    for seed in range(12):
        noise = 0.3 * np.random.default_rng(seed).normal(size=log.tau.shape)
        data = prepare_samples(replace(log, tau=log.tau + noise, qd=None, qdd=None))
        found = find_effects(model, drive, [data])
        assert [each.effect for each in found.found] == ["tilt"]
        fit = fit_samples(found.model, [data], drive=found.drive)
        own = found.lacking.bias(fit)
        assert "base tilt" not in own.effects
        values.append(fit.estimate.beta)
        alone.append(fit.uncertainty.std_errors)
        stated.append(np.sqrt(alone[-1] ** 2 + np.diag(own.covariance)))
    scatter = np.std(values, axis=0, ddof=1)
    tilted = np.median(stated, axis=0) > 1.5 * np.median(alone, axis=0)
    assert np.any(tilted)
    ratio = scatter[tilted] / np.median(stated, axis=0)[tilted]
    assert 0.6 < np.median(ratio) < 1.5


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
        options = StudyOptions(drive=FITTED, method="wls", checked=False, effects="none")
        study = identify(MODEL, data, options=options)
        error = np.abs(study.result.estimates - study.result.base.values(truth))
        held.append(error < 1.96 * study.result.std_errors)
        narrow.append(error < 1.96 * fitted(data).uncertainty.std_errors)
        assert "bias by what the model may lack" in " ".join(study.result.notes)
    assert np.mean(held) >= 0.93
    assert np.mean(narrow) < 0.8


@pytest.mark.study
def test_the_bias_that_two_results_share_is_no_error_of_their_difference() -> None:
    pair = [
        with_lacking(fit, data).concluded(*fit.metrics([data]))
        for data in (samples(1), samples(2))
        for fit in (fitted(data),)
    ]
    one, two = ComparedValues.own(pair[0]), ComparedValues.own(pair[1])
    between = Between(one, two)
    alone = np.hypot(one.std_errors, two.std_errors)
    plain = [
        ComparedValues.own(identify_samples(MODEL, data, drive=FITTED))
        for data in (samples(1), samples(2))
    ]
    scatter = Between(*plain).std_errors
    biased = alone > 3.0 * scatter
    assert np.sum(biased) >= 3
    assert np.all(between.std_errors[biased] < 0.5 * alone[biased])
    assert np.all(between.std_errors > 0.99 * scatter)
    swapped = Between(two, one)
    np.testing.assert_allclose(swapped.std_errors, between.std_errors, rtol=1e-12)
    test = between.test(np.ones(len(one.estimates), dtype=np.bool_))
    assert 0.001 < test.probability < 0.999
    assert test.degrees == len(one.estimates)
    narrow = between.std_errors / widening(between.degrees_of_freedom)
    np.testing.assert_allclose(np.sqrt(np.diag(between.covariance)), narrow, rtol=1e-6)
