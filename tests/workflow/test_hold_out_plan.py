"""By default a part is held out for the verdict, then the final fit is to everything."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import SignalChain, VirtualRobot, prepare_samples, resolve_chain
from asbuilt.identification import IdentificationResult
from asbuilt.workflow import StudyOptions, ValidationOptions, identify, validate
from command_line import document

MODEL = bundled_robot("two-link")


def recorded(seed, duration=20.0):
    machine = VirtualRobot.preset("lab", MODEL, 1, engine="inverse-dynamics")
    motion = random_fourier(MODEL, rng=seed, duration=duration)
    return machine.record(motion, rng=seed, rate=100.0).recording


@pytest.fixture(scope="module")
def log():
    return recorded(1)


def studied(log, **options):
    chosen = StudyOptions(**{"method": "wls", "checked": False, **options})
    return identify(MODEL, log, options=chosen)


def codes(study):
    return {finding.code for finding in study.findings}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"method": "auto"},
        {"drive": "viscous,coulomb,offset"},
        {"mounting": "estimate"},
        {"errors": "bootstrap"},
    ],
    ids=lambda options: next(iter(options.values()), "default"),
)
@pytest.mark.study
def test_the_default_changes_no_parameter_and_no_error(log, options) -> None:
    """The fit to everything is that of a study which holds nothing out, to the last digit."""
    by_default, whole = studied(log, **options), studied(log, **options, holdout=None)
    np.testing.assert_array_equal(by_default.result.estimates, whole.result.estimates)
    np.testing.assert_array_equal(by_default.result.std_errors, whole.result.std_errors)
    assert by_default.result.train.as_dict() == whole.result.train.as_dict()
    assert by_default.result.n_samples == whole.result.n_samples
    assert by_default.result.delay == whole.result.delay
    assert len(by_default.validations) == 1
    assert by_default.result.holdout == "blocks:3.3s:3"
    assert {"final_fit"} <= codes(by_default)
    assert "nothing_held_out" not in codes(by_default)


@pytest.mark.study
def test_the_verdict_is_of_a_fit_that_has_not_seen_what_is_held_out(log) -> None:
    chain = SignalChain(cutoff=6.0, delay=None)
    by_default = studied(log, chain=chain, effects="none")
    divided = studied(log, chain=chain, effects="none", holdout="blocks:3.3s:3")
    np.testing.assert_array_equal(by_default.result.trained, divided.result.estimates)
    for one, other in zip(by_default.result.validation, divided.result.validation, strict=True):
        np.testing.assert_array_equal(one.rms, other.rms)
    assert divided.result.trained is None
    assert by_default.result.n_samples > divided.result.n_samples


def test_the_same_log_gives_the_numbers_of_the_study_to_the_last_digit(log) -> None:
    result = studied(log).result
    again = IdentificationResult.from_json(result.to_json())
    (found,) = validate(again, log, options=ValidationOptions(checked=False))
    np.testing.assert_array_equal(found.metrics_as_built.rms, result.validation[0].rms)


def test_other_recordings_take_the_place_of_what_would_be_held_out(log) -> None:
    options = StudyOptions(method="wls", checked=False)
    study = identify(MODEL, log, validation=recorded(2), options=options)
    assert study.result.holdout is None
    assert len(study.validations) == 1
    assert "held out" not in study.validations[0].source
    assert not codes(study) & {"final_fit", "nothing_held_out"}


def test_a_short_recording_is_cut_in_two(log) -> None:
    part = slice(0, 500)
    study = studied({"t": log.t[part], "q": log.q[part], "tau": log.tau[part]})
    assert study.result.holdout == "last:0.5"
    assert "nothing_held_out" not in codes(study)
    assert study.verdict.use != "untested"


def test_a_part_that_the_filters_leave_nothing_of_is_not_held_out(log) -> None:
    """Blocks of 1.1 s are shorter than the memory of a filter of 1 Hz: the model is untested."""
    part = slice(0, 700)
    short = {"t": log.t[part], "q": log.q[part], "tau": log.tau[part]}
    study = studied(short, chain=SignalChain(cutoff=2.0, delay=None))
    assert study.result.holdout is None
    (said,) = [each.message for each in study.findings if each.code == "nothing_held_out"]
    assert "too little" in said
    assert study.verdict.text.startswith("UNTESTED: fits its log to ")


def test_samples_that_are_prepared_already_are_divided_too(log) -> None:
    samples = prepare_samples(log, resolve_chain(SignalChain(delay=None), log))
    by_default, whole = (
        studied(samples, effects="none", **more) for more in ({}, {"holdout": None})
    )
    np.testing.assert_array_equal(by_default.result.estimates, whole.result.estimates)
    assert len(by_default.validations) == 1


@pytest.mark.study
def test_the_command_line_says_both_and_takes_none(log, tmp_path, capsys) -> None:
    path = tmp_path / "log.csv"
    names = ["t", "q_1", "q_2", "tau_1", "tau_2"]
    rows = np.column_stack([log.t, log.q, log.tau])
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="")
    # One kind of fit, and no effects: what is left out tests the choice of both.
    asked = ("identify", "two-link", path, "--method", "consistent", "--effects", "none")
    by_default = document(capsys, *asked)
    nothing = document(capsys, *asked, "--holdout", "none")
    said = {each["code"]: each["message"] for each in by_default["warnings"]}
    assert "final fit to everything" in said["final_fit"]
    assert by_default["parameters"] == nothing["parameters"]
    assert len(by_default["validation"]) == 1
    assert nothing["validation"] == []
    assert nothing["holdout"] is None
