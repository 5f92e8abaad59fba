"""Held-out data that repeat the motion fitted are told from those of another motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot, load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    Samples,
    VirtualRobot,
    hold_out,
    prepare_samples,
    read_recordings,
)
from asbuilt.validation.generalisation.coverage import measure_repeated_share
from asbuilt.workflow import StudyOptions, identify

ROBOT = bundled_robot("scara")


def recorded(seed: int, periods: int = 1, take: int = 0) -> Recording:
    """Return one take of a motion: another take moves alike with other noise."""
    motion = random_fourier(ROBOT, seed, duration=10.0 * periods, n_harmonics=5, periods=periods)
    return (
        VirtualRobot.typical(ROBOT, rng=1)
        .record(motion, rate=200.0, rng=seed + 10 * periods + 100 * take)
        .recording
    )


def samples(seed: int, periods: int = 1) -> Samples:
    return prepare_samples(recorded(seed, periods))


def test_only_the_same_motion_repeats() -> None:
    one = samples(1)
    assert measure_repeated_share([one], samples(1)) > 0.95
    assert measure_repeated_share([samples(2), samples(3)], one) < 0.05
    assert measure_repeated_share([samples(2), one], one) == 1.0


@pytest.mark.parametrize(("periods", "repeats"), [(1, False), (4, True)])
def test_blocks_of_a_motion_that_comes_again_repeat(periods: int, repeats: bool) -> None:
    fitted, held = hold_out(samples(4, periods), "blocks:2s:3" if periods == 1 else "blocks:5s:3")
    assert (measure_repeated_share([fitted], held) > 0.6) == repeats


def test_few_moving_joints_say_nothing() -> None:
    one = samples(1)
    still = replace(
        one, q=np.where(np.arange(4) < 2, one.q, 0.3), qd=np.where(np.arange(4) < 2, one.qd, 0.0)
    )
    assert measure_repeated_share([still], still) == 0.0


@pytest.mark.study
def test_a_study_says_which_recording_is_no_other_motion() -> None:
    study = identify(
        ROBOT,
        [recorded(1)],
        validation=[recorded(1, take=1), recorded(2)],
        options=StudyOptions(method="wls"),
    )
    said = [warning.text for warning in study.findings if warning.code == "held_out_repeats"]
    assert len(said) == 1
    assert "repeats the training motion" in said[0]


@pytest.mark.study
def test_two_recordings_of_a_real_arm_are_one_motion(
    shared: Path,
) -> None:
    model = load_robot(shared / "models" / "kuka_lwr4.urdf")
    first, second = (
        read_recordings([shared / "data" / "kuka_lwr4" / f"measurements_{k}.npz"], model=model)[0]
        for k in (1, 2)
    )
    assert float(np.abs(first.q - second.q).max()) < 0.01
    said = {
        warning.code: warning.text
        for warning in identify(
            model, [first], validation=[second], options=StudyOptions(method="auto")
        ).findings
    }
    assert (
        "measurements_2.npz repeats the training motion in 100 % of its states"
        in said["held_out_repeats"]
    )
