"""Effects that are in a virtual robot and not in the model are named, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.generalisation.effect_evidence import own_evidence, tilt_evidence
from asbuilt.validation.generalisation.missing_effects import (
    missing_effects,
)
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.study import Study, identify

MODEL = bundled_robot("two-link")
FITTED = DriveSet.parse("viscous,coulomb,offset")
RICHER = DriveSet.parse("viscous,coulomb,offset,stribeck:velocity=0.1")


def stribeck_log() -> Recording:
    """Return a recording with Stribeck friction of half the Coulomb friction."""
    machine = VirtualRobot.ideal(MODEL).with_drive(RICHER, np.tile([1.0, 1.0, 0.5, 0.2], 2))
    log = machine.record(random_fourier(MODEL, rng=3, duration=30.0), rate=100.0).recording
    noise = 0.05 * np.random.default_rng(0).normal(size=log.tau.shape)
    return replace(log, tau=log.tau + noise, qd=None, qdd=None)


def studied(values: list[float], seed: int, drive: DriveSet = FITTED) -> Study:
    """Return a study of a robot with these viscous, Coulomb, Stribeck and offset torques."""
    machine = VirtualRobot.ideal(MODEL).with_drive(RICHER, np.tile(values, 2))
    log = machine.record(random_fourier(MODEL, rng=3, duration=30.0), rate=100.0).recording
    noise = 0.05 * np.random.default_rng(seed).normal(size=log.tau.shape)
    log = replace(log, tau=log.tau + noise, qd=None, qdd=None)
    return identify(MODEL, log, options=StudyOptions(drive=drive, method="wls", checked=False))


def test_unmodelled_stribeck_friction_is_named_with_its_cure() -> None:
    study = studied([1.0, 1.0, 0.5, 0.2], 0)
    finding = next(each for each in study.findings if each.code == "missing_effect")
    assert "stribeck at" in finding.message
    assert "stribeck" in finding.cure.settings["drive"]
    assert missing_effects(study.result)[0].sigmas > 4.0


@pytest.mark.parametrize("amount", [0.0, 0.5])
@pytest.mark.study
def test_a_right_model_lacks_nothing(amount: float) -> None:
    drive = RICHER if amount else FITTED
    named = [
        any(
            each.code == "missing_effect"
            for each in studied([1.0, 1.0, amount, 0.2], seed, drive).findings
        )
        for seed in range(6)
    ]
    assert sum(named) <= 1


def test_a_base_tilt_is_measured_by_a_fit_with_it() -> None:
    model = bundled_robot("ur10e")
    sizes = []
    for degrees in (0.0, 0.5):
        turned = Rotation.from_rotvec([np.deg2rad(degrees), 0.0, 0.0]).apply(
            np.array(model.gravity)
        )
        machine = VirtualRobot.ideal(model.with_gravity(turned))
        log = machine.record(random_fourier(model, rng=3, duration=30.0), rate=100.0).recording
        noise = 0.3 * np.random.default_rng(2).normal(size=log.tau.shape)
        samples = prepare_samples(replace(log, tau=log.tau + noise, qd=None, qdd=None))
        result = identify_samples(model, samples, method="wls")
        axes = axes_across(model.gravity)
        sizes.append(tilt_evidence(result, [samples], axes))
    level, tilted = sizes
    assert level < 4.0
    assert tilted > 10.0


def test_a_term_is_significant_where_it_is() -> None:
    study = studied([1.0, 1.0, 0.5, 0.2], 0)
    samples = prepare_samples(stribeck_log())
    found = own_evidence(study.result, [samples], "stribeck", [0, 1])
    assert set(found) == {0, 1}
    assert all(sigmas > 4.0 and p < 1e-3 for sigmas, p in found.values())
    absent = own_evidence(study.result, [samples], "load_friction", [0])
    assert absent[0][1] > found[0][1]


def test_without_cause_data_nothing_is_named() -> None:
    result = replace(studied([1.0, 1.0, 0.5, 0.2], 0).result, cause_data=None)
    assert missing_effects(result) == ()
