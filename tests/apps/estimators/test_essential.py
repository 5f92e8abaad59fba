"""Parameters that an F-test does not miss.

Set to zero, without an error, and no consumer of errors takes them for certain.
"""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from asbuilt.codec import format_json
from asbuilt.description import LinkInertia, load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.errors import InertiaError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import SensorNoise, VirtualRobot, prepare_samples
from asbuilt.identification import (
    IdentificationResult,
    choose_payload_frame,
    determination,
    identify_payload_samples,
    identify_samples,
    known_information,
    summarise,
)
from asbuilt.validation import CadTolerance, compare, compare_results
from asbuilt.workflow import Study
from asbuilt.writers import as_built, identify_document
from asbuilt.writers.models.physical import refuse_inconsistent
from asbuilt.writers.tables.tabular import tabulate_identified

DRIVE = DriveSet.parse("viscous,coulomb,offset")
TOOL = LinkInertia.from_com(1.8, [0.03, -0.02, 0.09], np.diag([0.011, 0.009, 0.006]))


def machine() -> VirtualRobot:
    """A UR10e whose offsets are nothing, and noise in which its small inertias drown."""
    model = load_robot("ur10e")
    robot = VirtualRobot.ideal(model).with_drive(DRIVE, np.tile([10.0, 5.0, 0.0], model.n_joints))
    return robot.with_noise(SensorNoise(torque_noise=2.0))


def moved(robot: VirtualRobot, seed: int):
    return prepare_samples(
        robot.record(
            random_fourier(robot.model, rng=seed, duration=20.0, n_harmonics=8),
            rate=200.0,
            rng=seed,
        ).recording
    )


@pytest.fixture(scope="module")
def results() -> tuple[IdentificationResult, IdentificationResult]:
    robot = machine()
    recorded = [moved(robot, seed) for seed in (1, 2)]
    essential, whole = (
        identify_samples(robot.model, recorded, drive=DRIVE, method=method)
        for method in ("essential", "wls")
    )
    return essential, whole


@pytest.fixture(scope="module")
def essential(results: tuple[IdentificationResult, IdentificationResult]) -> IdentificationResult:
    assert 5 < results[0].dropped.sum() < results[0].n_base - 5
    return results[0]


def test_what_is_dropped_has_no_error_and_the_rest_has_one(essential: IdentificationResult) -> None:
    dropped = essential.dropped
    assert np.all(np.isnan(essential.std_errors[dropped]))
    assert np.all(np.isnan([p.textbook_std_error for p in essential.parameters if p.dropped]))
    assert np.all(np.isnan([p.relative_error for p in essential.parameters if p.dropped]))
    assert np.all(essential.estimates[dropped] == 0.0)
    assert np.all(essential.std_errors[~dropped] > 0.0)
    assert np.all(essential.covariance[dropped] == 0.0)
    assert (
        f"{essential.n_base - dropped.sum()} of {essential.n_base} parameters are essential"
        in essential.notes[0]
    )


def test_files_say_null_and_not_zero(essential: IdentificationResult) -> None:
    study = Study(essential, essential.findings)
    stored, printed = (
        json.loads(essential.to_json()),
        json.loads(format_json(identify_document(study))),
    )
    rows = list(csv.DictReader(io.StringIO(tabulate_identified(essential).as_csv())))
    for parameter, one, other, row in zip(
        essential.parameters, stored["parameters"], printed["parameters"], rows, strict=True
    ):
        assert (
            (one["std_error"] is None)
            == (other["std_error"] is None)
            == (row["std_error"] == "")
            == parameter.dropped
        )
        assert one["dropped"] == other["dropped"] == (row["dropped"] == "yes") == parameter.dropped
    again = IdentificationResult.from_json(essential.to_json())
    np.testing.assert_array_equal(again.dropped, essential.dropped)
    np.testing.assert_array_equal(again.std_errors, essential.std_errors)


def test_the_summary_shows_them_as_dropped(essential: IdentificationResult) -> None:
    lines = summarise(essential).as_text(full=True).splitlines()
    marked = {
        int(line.split()[0])
        for line in lines
        if re.match(r" *\d+ +\S", line) and line.count("dropped") == 2
    }
    assert marked == set(essential.base.ids[essential.dropped].tolist())


def test_determination_lists_them_apart(essential: IdentificationResult) -> None:
    found = determination(essential)
    names = [
        set(part)
        for part in (found.well, found.fairly, found.hardly, found.not_at_all, found.dropped)
    ]
    assert set.union(*names) == set(essential.base.names)
    assert sum(map(len, names)) == essential.n_base
    assert names[-1] == {
        name for name, gone in zip(essential.base.names, essential.dropped, strict=True) if gone
    }
    assert f"dropped: {len(found.dropped)}" in found.in_short
    assert not names[-1] & {name for advice in found.advice for name in advice.names}


def test_they_tell_a_further_motion_nothing_and_the_others_all_they_did(
    essential: IdentificationResult,
) -> None:
    information, kept = known_information(essential), np.flatnonzero(~essential.dropped)
    assert np.all(information[essential.dropped] == 0.0)
    own = np.ix_(kept, kept)
    product = information[own] @ essential.covariance[own]
    np.testing.assert_allclose(product, np.eye(len(kept)), atol=1e-6)


def test_compare_neither_tests_nor_counts_them(essential: IdentificationResult) -> None:
    comparison = compare(essential, tolerance=CadTolerance())
    verdicts = {p.name: p.verdict for p in comparison.parameters}
    assert {name for name, verdict in verdicts.items() if verdict == "dropped"} == {
        p.name for p in essential.parameters if p.dropped
    }
    assert all(
        p.p_value is None and p.std_error is None
        for p in comparison.parameters
        if p.verdict == "dropped"
    )
    tested = sum(verdict in ("differs", "agrees") for verdict in verdicts.values())
    assert comparison.n_compared == tested == comparison.chi_square.degrees
    assert "dropped" in comparison.as_text(full=True)
    json.loads(format_json(comparison.as_document()))


def test_a_parameter_dropped_on_one_side_is_no_change(
    results: tuple[IdentificationResult, IdentificationResult],
) -> None:
    stored = replace(results[0], free=None), results[1]
    for pair in (stored, stored[::-1]):
        drift = compare_results(*pair)
        assert {change.name for change in drift.parameters if change.dropped} == {
            p.name for p in results[0].parameters if p.dropped
        }
        assert not any(change.changed for change in drift.parameters if change.dropped)
        assert drift.chi_square.degrees == results[0].n_base - results[0].dropped.sum()
        said = (
            f"{results[0].dropped.sum()} parameters that one result or both dropped are not tested"
        )
        assert said in " ".join(drift.as_text(full=True).split())
        json.loads(format_json(drift.as_document()))


def test_two_methods_on_one_recording_are_no_change_at_all(
    results: tuple[IdentificationResult, IdentificationResult],
) -> None:
    drift = compare_results(*results)
    assert not any(change.dropped for change in drift.parameters)
    np.testing.assert_allclose(
        [change.after for change in drift.parameters], results[1].estimates, rtol=1e-12
    )
    assert drift.chi_square.degrees == results[0].n_base
    assert drift.chi_square.statistic < 1e-9


def test_a_payload_is_weighed_with_them_at_zero(
    results: tuple[IdentificationResult, IdentificationResult],
) -> None:
    robot = machine()
    frame, _, _ = choose_payload_frame(robot.model)
    loaded, bare = moved(robot.with_tool(TOOL, at=frame), 3), moved(robot, 4)
    for arm in ("refined", "frozen"):
        light, full = (
            identify_payload_samples(result, loaded, unloaded=[bare], arm=arm) for result in results
        )
        assert light.values[0] == pytest.approx(TOOL.mass, abs=5 * light.std_errors[0])
        assert light.values[0] == pytest.approx(full.values[0], abs=5 * full.std_errors[0])
        assert 0.2 < light.std_errors[0] / full.std_errors[0] < 2.0
        np.testing.assert_allclose(light.arm[results[0].dropped], 0.0, atol=1e-12)
        assert np.all(np.isfinite(light.covariance))
    frozen = identify_payload_samples(results[0], loaded, arm="frozen").arm
    np.testing.assert_allclose(frozen, results[0].estimates, rtol=1e-6, atol=1e-8)


def test_a_refusal_to_export_does_not_take_zeros_for_measurements(
    essential: IdentificationResult,
) -> None:
    with pytest.raises(InertiaError, match="dropped parameters count as zero"):
        refuse_inconsistent(as_built(essential).model, essential)
