"""Kind of fit and effects, tested by motion that was left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import identify, load_robot, simulate_recording
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification.effects.families.drive_terms import drop_terms
from asbuilt.identification.identify import Fit, fit_samples
from asbuilt.workflow import Prepared, prepare
from asbuilt.workflow.tested_choice import LeftOut, drop_parameters

LWR4 = "data/kuka_lwr4"


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    arm = load_robot("ur10e")
    logs = [
        simulate_recording(arm, random_fourier(arm, rng=k, duration=10.0), rate=100.0, rng=k)
        for k in (1, 2)
    ]
    return prepare(arm, logs[:1], validation=logs[1:], holdout=None, checked=False)


@pytest.fixture(scope="module")
def fit(prepared: Prepared) -> Fit:
    drive = DriveSet.parse("viscous,coulomb,offset,spring:joints=2")
    return fit_samples(load_robot("ur10e"), prepared.training, drive=drive, method="wls")


def test_a_fit_without_a_parameter_is_least_squares_without_its_column(fit: Fit) -> None:
    estimate = fit.estimate
    place = fit.base.names.index("Ks2")
    rows = fit.information.stacked(estimate.weights)
    others = np.delete(np.arange(fit.base.n_base), place)
    wanted, *_ = np.linalg.lstsq(rows[:, others], rows[:, -1], rcond=None)
    found = drop_parameters(estimate, np.array([place]))
    assert found[place] == pytest.approx(0.0, abs=1e-12)
    # Torques, as single parameters may hardly be determined.
    # In the largest of them: weighted by its noise that is 2e5, of which 1e-6 is rounding.
    most = 1e-10 * np.abs(rows[:, -1]).max()
    np.testing.assert_allclose(rows[:, others] @ (found[others] - wanted), 0.0, atol=most)


def test_a_repetition_of_the_motion_tests_nothing(fit: Fit, prepared: Prepared) -> None:
    assert LeftOut.of(fit, prepared) is not None
    same: tuple[Samples, ...] = prepared.training
    assert LeftOut.of(fit, replace(prepared, validation=same)) is None


@pytest.mark.study
def test_the_default_is_as_good_as_the_best_way_on_blocks_left_out(shared: Path) -> None:
    log = shared / "data/panda/panda_gaz.csv"
    if not log.is_file():
        pytest.skip("the shared recordings are absent")
    ways = ({}, {"method": "consistent"}, {"method": "wls"}, {"method": "wls", "effects": "none"})
    errors = []
    for way in ways:
        study = identify("franka-panda", log, holdout="blocks:5s:3", checked=False, **way)
        errors.append(study.validations[0].metrics_as_built.relative_error)
    assert errors[0] < 1.03 * min(errors)


@pytest.mark.study
def test_no_effect_of_a_model_is_under_two_errors(shared: Path) -> None:
    logs = [shared / LWR4 / f"measurements_{k}.npz" for k in (1, 2, 3)]
    if not logs[0].is_file():
        pytest.skip("the shared recordings are absent")
    study = identify(shared / "models/kuka_lwr4.urdf", logs[:2], validation=logs[2:], checked=False)
    held = [effect for effect in study.effects if effect.in_model and effect.std_error]
    assert held
    assert all(abs(effect.estimate) >= 2.0 * effect.std_error for effect in held)


def test_a_term_that_goes_leaves_its_place_to_the_simpler_one() -> None:
    names = ("one", "two", "three")
    drive = DriveSet.parse("viscous:joints=2/3,power:exponent=0.5:joints=1,offset")
    without = drop_terms(drive, {("power", "one")}, names)
    assert without == DriveSet.parse("viscous,offset")


@pytest.mark.study
def test_an_effect_that_may_be_zero_goes_unless_what_was_left_out_shows_it(shared: Path) -> None:
    log = shared / "data/z1/zn_a.csv"
    if not log.is_file():
        pytest.skip("the shared recordings are absent")
    study = identify(shared / "models/z1/z1.xml", log, torque_source="motor", checked=False)
    held = [each for each in study.effects if each.in_model and not each.confounded_with]
    assert held
    assert not any(each.feasible and each.feasible[0] < 0.0 < each.feasible[1] for each in held)


@pytest.mark.study
@pytest.mark.parametrize("train", [(1,), (1, 2)])
def test_the_exported_robot_predicts_other_motion_as_the_fit_does(
    shared: Path, train: tuple[int, ...]
) -> None:
    folder = shared / LWR4
    if not folder.is_dir():
        pytest.skip("the shared recordings are absent")
    study = identify(
        shared / "models/kuka_lwr4.urdf",
        [folder / f"measurements_{k}.npz" for k in train],
        validation=folder / "measurements_3.npz",
        checked=False,
    )
    other = study.validations[-1]
    assert other.metrics_exported is not None
    fitted = other.metrics_as_built.relative_error
    assert other.metrics_exported.relative_error == pytest.approx(fitted, rel=0.01)
