"""Held out for the verdict, then fitted to everything; the stored numbers can be repeated."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description.catalogue import bundled_robot
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.workflow.options import StudyOptions, ValidationOptions
from asbuilt.workflow.study import identify
from asbuilt.workflow.validation import validate


@pytest.fixture(scope="module")
def log():
    model = bundled_robot("two-link")
    machine = VirtualRobot.preset("lab", model, 1, engine="inverse-dynamics")
    return machine.record(random_fourier(model, rng=1, duration=20.0), rng=1, rate=100.0).recording


def studied(log, holdout):
    options = StudyOptions(holdout=holdout, method="wls", checked=False)
    return identify(bundled_robot("two-link"), log, options=options)


def test_parameters_are_of_everything_and_validation_is_of_the_rest(log) -> None:
    automatic, divided, whole = (studied(log, rule) for rule in ("auto", "blocks:3.3s:3", None))
    assert automatic.result.holdout == "blocks:3.3s:3"
    np.testing.assert_array_equal(automatic.result.estimates, whole.result.estimates)
    np.testing.assert_array_equal(automatic.result.trained, divided.result.estimates)
    for one, other in zip(automatic.result.validation, divided.result.validation, strict=True):
        np.testing.assert_array_equal(one.rms, other.rms)
    assert automatic.result.train.rms == pytest.approx(whole.result.train.rms)
    assert automatic.result.n_samples > divided.result.n_samples
    assert "final fit to everything" in " ".join(automatic.summary.as_text(full=True).split())
    assert "nothing_held_out" not in {finding.code for finding in automatic.findings}


def test_the_same_log_gives_the_numbers_of_the_study_to_the_last_digit(log) -> None:
    result = studied(log, "auto").result
    again = IdentificationResult.from_json(result.to_json())
    (found,) = validate(again, log, options=ValidationOptions(checked=False))
    np.testing.assert_array_equal(found.metrics_as_built.rms, result.validation[0].rms)


def test_a_recording_that_is_too_short_is_not_divided(log) -> None:
    part = slice(0, 500)
    short = {"t": log.t[part], "q": log.q[part], "tau": log.tau[part]}
    study = studied(short, "auto")
    assert study.result.holdout is None
    assert study.result.trained is None
    assert "nothing_held_out" in {finding.code for finding in study.findings}
