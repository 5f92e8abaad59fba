"""Effects that are in a virtual robot and not in the model are named, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description.catalogue import bundled_robot
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.validation.generalisation.missing_effects import (
    missing_effects,
)
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.study import Study, identify

MODEL = bundled_robot("two-link")
FITTED = DriveSet.parse("viscous,coulomb,offset")
RICHER = DriveSet.parse("viscous,coulomb,offset,stribeck:velocity=0.1")


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


def test_without_cause_data_nothing_is_named() -> None:
    result = replace(studied([1.0, 1.0, 0.5, 0.2], 0).result, cause_data=None)
    assert missing_effects(result) == ()
