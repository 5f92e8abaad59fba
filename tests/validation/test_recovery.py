"""What is found of a truth must be measured as it was made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet
from asbuilt.errors import ResultError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import PERFECT_SENSORS, DataLogger, SimulatedRecording, VirtualRobot
from asbuilt.identification import IdentificationResult
from asbuilt.validation import compare_with_truth
from asbuilt.workflow import StudyOptions, identify


@pytest.fixture(scope="module")
def identified() -> tuple[IdentificationResult, SimulatedRecording]:
    model = bundled_robot("ur10e")
    robot = VirtualRobot.preset("lab", model, rng=1).logging(250.0)
    learned = [
        robot.record(random_fourier(model, k, duration=15.0, n_harmonics=5 + k), rng=k).recording
        for k in range(2)
    ]
    study = identify(model, learned, options=StudyOptions(drive=robot.drive, checked=False))
    clean = replace(
        robot, sensors=PERFECT_SENSORS, logger=DataLogger(rate=50.0, accelerations=True)
    )
    return study.result, replace(
        clean.record(random_fourier(model, 9, duration=5.0)), truth=robot.truth
    )


@pytest.mark.study
def test_a_lab_recording_leads_back_to_the_truth(
    identified: tuple[IdentificationResult, SimulatedRecording],
) -> None:
    recovery = compare_with_truth(*identified)
    assert len(recovery.names) == 36 + 18
    assert recovery.within(2.0) > 0.85
    assert recovery.within(4.0) > 0.95
    assert (recovery.of_links.sum(), (~recovery.of_links).sum()) == (36, 18)
    links, drives = (recovery.within(2.0, of_links=of_links) for of_links in (True, False))
    assert 36 * links + 18 * drives == pytest.approx(54 * recovery.within(2.0))
    assert recovery.torque_error < 0.1 * recovery.cad_error
    assert recovery.torque_error < 2e-3


@pytest.mark.study
def test_errors_are_those_of_the_parameters(
    identified: tuple[IdentificationResult, SimulatedRecording],
) -> None:
    """A truth moved by one parameter's worth of standard errors is missed by as many."""
    result, simulated = identified
    before = compare_with_truth(result, simulated)
    k = before.names.index("m6") if "m6" in before.names else len(before.names) - 1
    column = int(result.base.columns[k])
    moved = np.array(simulated.truth)
    moved[column] += 3.0 * before.std_error[k]
    after = compare_with_truth(result, replace(simulated, truth=moved))
    assert after.deviations[k] == pytest.approx(before.deviations[k] - 3.0, abs=1e-6)


@pytest.mark.study
def test_what_cannot_be_compared_is_refused(
    identified: tuple[IdentificationResult, SimulatedRecording],
) -> None:
    result, simulated = identified
    with pytest.raises(
        ResultError, match=r"drive terms viscous,coulomb,offset, the truth .* and viscous"
    ):
        compare_with_truth(result, replace(simulated, drive=DriveSet.parse("viscous")))
    with pytest.raises(
        ResultError, match="has no velocities and accelerations; record with DataLogger"
    ):
        compare_with_truth(
            result, replace(simulated, recording=replace(simulated.recording, qdd=None))
        )


@pytest.mark.study
def test_a_dropped_parameter_has_no_error_to_lie_within(
    identified: tuple[IdentificationResult, SimulatedRecording],
) -> None:
    result, simulated = identified
    whole = compare_with_truth(result, simulated)
    k = int(np.argmax(np.abs(whole.deviations)))
    gone = [
        replace(p, std_error=np.nan, textbook_std_error=np.nan, dropped=True) if j == k else p
        for j, p in enumerate(result.parameters)
    ]
    recovery = compare_with_truth(replace(result, parameters=tuple(gone)), simulated)
    assert np.isnan(recovery.deviations[k])
    others = np.delete(np.abs(whole.deviations), k)
    assert recovery.within(1.0) == pytest.approx(np.mean(others <= 1.0))
    assert recovery.within(np.inf) == 1.0
