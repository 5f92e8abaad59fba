"""The cutoff is chosen by torque that no filter touched."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.errors import RecordingError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, SensorNoise, VirtualRobot
from asbuilt.workflow import CutoffSweep, StudyOptions, identify, sweep_cutoffs

DRIVE = DriveSet.parse("viscous,coulomb,offset")


@pytest.fixture(scope="module")
def recording() -> Recording:
    model = load_robot("ur10e")
    noise = SensorNoise(encoder_counts=2.0**13, torque_noise=0.5)
    robot = (
        VirtualRobot.ideal(model).with_drive(DRIVE, np.tile([1.0, 2.0, 0.3], 6)).with_noise(noise)
    )
    return robot.record(
        random_fourier(model, rng=1, duration=24.0, n_harmonics=8), rate=200.0, rng=2
    ).recording


@pytest.fixture(scope="module")
def sweep(recording: Recording) -> CutoffSweep:
    return sweep_cutoffs(
        load_robot("ur10e"), [recording], drive=DRIVE, cutoffs=[0.6, 3.0, 6.0, 30.0]
    )


@pytest.mark.study
def test_too_high_a_cutoff_costs(sweep: CutoffSweep) -> None:
    """Noise of 0.5 N m is the floor; encoder steps swamp accelerations at 30 Hz.

    At 0.6 Hz the filter needs more time than a block has.
    """
    assert [trial.cutoff for trial in sweep.trials] == [3.0, 6.0, 30.0]
    assert sweep.chosen in (3.0, 6.0)
    assert sweep.trials[-1].score > 1.5
    assert all(np.all(trial.rms_recorded > 0.45) for trial in sweep.trials)
    assert all(trial.in_band < trial.score for trial in sweep.trials)


@pytest.mark.study
def test_sweep_is_printed_with_its_reason(sweep: CutoffSweep) -> None:
    text = sweep.table().as_text(full=True)
    assert "<- chosen" in text
    assert sweep.why in " ".join(text.split())
    assert "blocks:5s:3 of the recordings identified from" in text
    json.dumps(sweep.as_document(), allow_nan=False)


@pytest.mark.study
def test_a_statistic_that_is_not_known_is_a_dash(sweep: CutoffSweep) -> None:
    """At a low cutoff the stretches held out may be shorter than half a period."""
    unknown = replace(
        sweep, trials=(replace(sweep.trials[0], durbin_watson=np.nan), *sweep.trials[1:])
    )
    assert "nan" not in unknown.table().as_text()
    assert (
        json.loads(json.dumps(unknown.as_document(), allow_nan=False))["trials"][0]["durbin_watson"]
        is None
    )


@pytest.mark.study
def test_study_uses_and_states_the_chosen_cutoff(recording: Recording) -> None:
    study = identify(
        load_robot("ur10e"),
        [recording],
        options=StudyOptions(drive=DRIVE, sweep_cutoff=True, holdout="last:0.3", method="wls"),
    )
    assert study.cutoffs is not None
    assert any(study.cutoffs.why in note for note in study.result.notes)


@pytest.mark.study
def test_cutoffs_tried_are_apart(recording: Recording) -> None:
    """Else two would be written over each other in the figure.

    The highest is bounded by the sampling rate.
    """
    slow = recording.between(0.0, 12.0)
    tried = np.array(
        [trial.cutoff for trial in sweep_cutoffs(load_robot("ur10e"), [slow], drive=DRIVE).trials]
    )
    assert np.all(tried[1:] / tried[:-1] > 1.15)
    assert tried[-1] <= 0.2 * slow.rate + 1e-9


def test_recording_too_short_for_any_cutoff_is_refused(recording: Recording) -> None:
    with pytest.raises(RecordingError, match="no cutoff"):
        sweep_cutoffs(
            load_robot("ur10e"), [recording.between(0.0, 0.5)], drive=DRIVE, cutoffs=[0.5]
        )
