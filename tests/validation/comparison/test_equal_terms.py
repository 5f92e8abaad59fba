"""Two results of one robot by whatever estimators.

What has not changed is not said to have, and what has is.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from asbuilt.description import LinkInertia, bundled_robot
from asbuilt.dynamics import observation_matrix
from asbuilt.errors import ResultError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import SignalChain, VirtualRobot, hold_out, prepare_samples
from asbuilt.identification import IdentificationResult, identify_samples
from asbuilt.validation import Drift, compare_results
from asbuilt.validation.comparison.equal_terms import ComparedValues
from asbuilt.validation.comparison.significance import chi_square
from asbuilt.workflow import StudyOptions, identify

ROBOT = bundled_robot("kuka-iiwa7-r800")
SEED = 14
WORN = 2
"""Place of the joint whose friction rises."""
LOAD = LinkInertia.from_com(0.5, [0.01, 0.0, 0.04], np.diag([4e-4, 4e-4, 2e-4]))


def robot_of(change: str) -> VirtualRobot:
    robot = VirtualRobot.preset("lab", ROBOT, rng=SEED)
    if change == "load":
        return robot.with_tool(LOAD)
    if change == "wear":
        more = np.where(np.arange(ROBOT.n_joints) == WORN, 1.3, 1.0)
        raised = {
            name: tuple(more * robot.train.of(name, ROBOT.n_joints))
            for name in ("viscous", "coulomb")
        }
        return replace(robot, train=replace(robot.train, **raised))
    return robot


@cache
def identified(motion: int, change: str = "", method: str = "huber") -> IdentificationResult:
    recording = (
        robot_of(change)
        .record(
            random_fourier(ROBOT, 1000 + SEED + 500 * motion, duration=30.0), rng=SEED + 77 * motion
        )
        .recording
    )
    return identify(
        ROBOT,
        [recording],
        options=StudyOptions(method=method, holdout="blocks:2s:3", checked=False),
    ).result


def alarmed(drift: Drift) -> list[str]:
    return [joint.joint for joint in drift.joints if joint.holm <= drift.level]


@pytest.mark.study
def test_a_robot_that_did_not_change_is_not_said_to_have_because_the_estimators_differ() -> None:
    results = identified(0), identified(1, method="wls")
    assert results[0].method != results[1].method
    drift = compare_results(*results)
    assert drift.n_changed == 0
    assert drift.chi_square.probability > 0.01
    assert not alarmed(drift)
    assert any(sentence.startswith("Compared by wls of both") for sentence in drift.sentences)
    plain = compare_results(identified(0, method="wls"), identified(1, method="wls"))
    np.testing.assert_allclose(
        [each.sigmas for each in drift.parameters],
        [each.sigmas for each in plain.parameters],
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        [each.p_value for each in drift.joints], [each.p_value for each in plain.joints], rtol=1e-6
    )
    assert not any("Compared" in sentence for sentence in plain.sentences)
    unequal = compare_results(*(replace(result, free=None) for result in results))
    assert any("Identify both again" in sentence for sentence in unequal.sentences)
    assert not np.allclose(
        [each.sigmas for each in unequal.parameters],
        [each.sigmas for each in plain.parameters],
        atol=0.5,
    )


@pytest.mark.study
def test_wear_of_a_third_is_found_at_its_joint() -> None:
    drift = compare_results(identified(0), identified(1, "wear", "auto"))
    changed = {change.name for change in drift.parameters if change.changed}
    assert {f"Fc{WORN + 1}", f"Fv{WORN + 1}"} & changed
    assert ROBOT.joint_names[WORN] in alarmed(drift)


@pytest.mark.study
def test_half_a_kilogram_at_the_flange_is_found() -> None:
    drift = compare_results(identified(0), identified(1, "load", "auto"))
    assert drift.n_changed > 0
    assert drift.chi_square.probability < 1e-6
    assert {"A2", "A4"} <= set(alarmed(drift))


@pytest.mark.study
def test_free_values_are_those_of_lapack_on_the_rows_themselves() -> None:
    recording = robot_of("").record(random_fourier(ROBOT, 1, duration=12.0), rng=1).recording
    train, _ = hold_out(prepare_samples(recording, SignalChain()), "blocks:2s:3")
    whole = replace(train, parallel=None)
    result = identify_samples(ROBOT, whole, drive=identified(0).base.drive, method="consistent")
    assert result.free is not None
    rows = observation_matrix(
        ROBOT, whole.q, whole.qd, whole.qdd, drive=result.base.drive, columns=result.base.columns
    )
    torque = whole.tau.ravel()
    sigma, expected = np.ones(ROBOT.n_joints), np.zeros(result.n_base)
    for _ in range(30):
        weight = np.tile(1.0 / sigma, len(whole.tau))
        expected = np.linalg.lstsq(rows * weight[:, None], torque * weight, rcond=None)[0]
        spent = (
            np.sum(np.linalg.qr(rows * weight[:, None])[0] ** 2, axis=1)
            .reshape(whole.tau.shape)
            .sum(axis=0)
        )
        left = (torque - rows @ expected).reshape(whole.tau.shape)
        sigma = np.sqrt(np.sum(left**2, axis=0) / (len(whole.tau) - spent))
    np.testing.assert_allclose(
        result.free.estimates, expected, atol=1e-3 * result.free.std_errors.min()
    )
    assert not np.allclose(result.free.estimates, result.estimates, rtol=1e-3)


@pytest.mark.study
def test_results_keep_their_free_values_in_a_file() -> None:
    result = identified(0)
    read = IdentificationResult.from_json(result.to_json())
    assert result.free is not None
    assert read.free is not None
    np.testing.assert_array_equal(read.free.estimates, result.free.estimates)
    np.testing.assert_array_equal(read.free.covariance, result.free.covariance)
    np.testing.assert_array_equal(read.free.determined, result.free.determined)


@pytest.mark.study
def test_files_without_free_values_load_and_damaged_ones_are_refused() -> None:
    whole = json.loads(identified(0).to_json())
    old = {name: value for name, value in whole.items() if name != "free"}
    assert IdentificationResult.from_json(json.dumps(old)).free is None
    with pytest.raises(ResultError, match="stored result is damaged"):
        IdentificationResult.from_json(
            json.dumps(whole | {"free": whole["free"] | {"covariance": "AAAA"}})
        )


@pytest.mark.study
def test_a_result_by_weighted_least_squares_is_its_own_free_one() -> None:
    train, _ = hold_out(
        prepare_samples(
            robot_of("").record(random_fourier(ROBOT, 2, duration=12.0), rng=2).recording,
            SignalChain(),
        ),
        "blocks:2s:3",
    )
    drive = identified(0).base.drive
    plain, real = (
        identify_samples(ROBOT, train, drive=drive, method=method)
        for method in ("wls", "consistent")
    )
    assert plain.free is None
    values = ComparedValues.free(plain)
    assert real.free is not None
    np.testing.assert_allclose(real.free.estimates, values.estimates, rtol=1e-12)
    np.testing.assert_allclose(real.free.covariance, values.covariance, rtol=1e-9, atol=1e-18)


def test_sums_known_only_together_are_tested_with_errors_grown_alike() -> None:
    rng = np.random.default_rng(5)
    textbook = np.array([[1.0, 0.9999, 0.0], [0.9999, 1.0, 0.0], [0.0, 0.0, 4.0]])
    growth = np.array([1.5, 2.5, 2.0])
    none = np.zeros(3, dtype=bool)
    values = ComparedValues(
        np.zeros(3),
        textbook * np.outer(growth, growth),
        growth * np.sqrt(np.diag(textbook)),
        np.sqrt(np.diag(textbook)),
        ~none,
        none,
    )
    np.testing.assert_allclose(values.even_covariance, textbook * np.mean(growth**2), rtol=1e-12)
    draws = rng.multivariate_normal(np.zeros(3), 2.0**2 * textbook, size=2000)
    alarms = {
        name: np.mean([chi_square(draw, covariance).probability < 1e-3 for draw in draws])
        for name, covariance in (
            ("each by its own", values.covariance),
            ("alike", values.even_covariance),
        )
    }
    assert alarms["alike"] < 0.005
    assert alarms["each by its own"] > 0.5


def test_dropped_parameters_have_no_part_in_it() -> None:
    none = np.array([False, True])
    values = ComparedValues(
        np.zeros(2),
        np.diag([4.0, 0.0]),
        np.array([2.0, np.nan]),
        np.array([1.0, np.nan]),
        ~none,
        none,
    )
    np.testing.assert_array_equal(values.even_covariance, np.diag([4.0, 0.0]))
