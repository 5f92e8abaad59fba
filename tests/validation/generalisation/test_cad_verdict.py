"""Verdict against CAD on invented predictions whose order is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from asbuilt.identification import Prediction
from asbuilt.validation import Validation, cad_verdict
from asbuilt.validation.generalisation.cad_verdict import report_cad_verdicts

N, RATE = 2000, 100.0


def predicted(built: tuple[float, float], cad: tuple[float, float], seed: int = 0) -> Validation:
    """Return predictions of two joints with errors of these RMS sizes, new each 0.1 s."""
    rng = np.random.default_rng(seed)
    measured = rng.normal(size=(N, 2))
    off = [np.repeat(rng.normal(size=(N // 10, 2)), 10, axis=0) * size for size in (built, cad)]
    t, names = np.arange(N) / RATE, ("elbow", "wrist")
    metrics = [
        Prediction(t, measured, measured + each, np.ones(2), names, "log").metrics() for each in off
    ]
    still = np.zeros((N, 2))
    return Validation(
        "log", names, ("N m", "N m"), t, still, measured, measured + off[0], measured + off[1],
        still, *metrics,
    )  # fmt: skip


def test_a_joint_that_cad_predicts_better_is_worse_and_named_first() -> None:
    verdict = cad_verdict(predicted((0.2, 0.5), (0.5, 0.2)))
    assert [joint.outcome for joint in verdict.joints] == ["better", "worse"]
    assert verdict.is_worse
    assert verdict.sentence.startswith("As built against CAD on log: WORSE at wrist (0.")
    assert verdict.joints[1].sigmas < -5.0
    assert report_cad_verdicts([predicted((0.2, 0.5), (0.5, 0.2))])[0].severity == "info"


def test_a_better_model_is_better_on_the_whole() -> None:
    verdict = cad_verdict(predicted((0.2, 0.2), (0.5, 0.4)))
    assert not verdict.is_worse
    assert verdict.whole.outcome == "better"
    assert verdict.as_dict()["joints"][0]["as_built"] == pytest.approx(0.2, rel=0.2)


def test_equal_errors_are_called_different_as_often_as_the_level_allows() -> None:
    outcomes = [
        any(joint.outcome != "undecided" for joint in cad_verdict(validation).joints)
        for seed in range(400)
        for validation in (predicted((0.3, 0.3), (0.3, 0.3), seed),)
    ]
    low, high = stats.binom.interval(0.999, 400, 0.05)
    assert low <= sum(outcomes) <= high


def test_two_blocks_are_too_short_for_a_verdict() -> None:
    whole = predicted((0.2, 0.2), (0.5, 0.4))
    few = {name: getattr(whole, name)[:150] for name in ("t", "velocity", "measured", "drive")}
    short = Validation(
        "log", whole.joint_names, whole.units, few["t"], few["velocity"], few["measured"],
        whole.predicted[:150], whole.predicted_cad[:150], few["drive"],
        whole.metrics_as_built, whole.metrics_cad,
    )  # fmt: skip
    verdict = cad_verdict(short)
    assert verdict.joints[0].sigmas is None
    assert verdict.sentence.endswith("too short for a verdict.")
    assert not verdict.is_worse


def test_a_joint_without_masses_is_not_one_that_cad_predicts_better() -> None:
    whole = predicted((2.0, 0.2), (0.5, 0.4))
    first = whole.predicted_cad * [0.0, 1.0]
    verdict = cad_verdict(replace(whole, predicted_cad=first))
    assert [joint.outcome for joint in verdict.joints] == ["undecided", "better"]
    assert not verdict.is_worse
    assert "elbow" not in verdict.sentence
    none = cad_verdict(replace(whole, predicted_cad=0.0 * first))
    assert none.sentence.endswith("CAD has no masses.")
    assert {joint.outcome for joint in (none.whole, *none.joints)} == {"undecided"}
    assert not none.is_worse


def test_one_block_of_fast_motion_does_not_hide_a_better_model() -> None:
    alike = predicted((0.02, 0.02), (0.5, 0.5))
    sizes = np.where(np.arange(N) // 100 == 7, 30.0, 1.0)[:, None]
    measured, built, cad = (
        sizes * each for each in (alike.measured, alike.predicted, alike.predicted_cad)
    )
    found = cad_verdict(replace(alike, measured=measured, predicted=built, predicted_cad=cad))
    assert [joint.outcome for joint in found.joints] == ["better", "better"]
    gains = np.mean((cad - measured) ** 2, axis=1) - np.mean((built - measured) ** 2, axis=1)
    assert stats.ttest_1samp(gains.reshape(20, -1).mean(axis=1), 0.0).pvalue > 0.2


def test_an_order_that_the_errors_do_not_have_is_undecided() -> None:
    alike = predicted((0.2, 0.2), (0.5, 0.5))
    once = np.where(np.arange(N) // 100 == 3, 100.0, 0.0)[:, None]
    found = cad_verdict(replace(alike, predicted=alike.predicted + once))
    assert [joint.outcome for joint in found.joints] == ["undecided", "undecided"]


def test_without_cad_masses_there_is_no_verdict() -> None:
    alike = predicted((0.2, 0.2), (0.5, 0.5))
    assert report_cad_verdicts([replace(alike, predicted_cad=np.zeros((N, 2)))]) == ()
