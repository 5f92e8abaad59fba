"""A design for a purpose, and whether a log is of the motion that was sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import asbuilt
from asbuilt import DesignOptions, DriveSet, RecordingError
from asbuilt.apps.run.rounds import check_log, measure_distance
from asbuilt.excitation import SplineMotion

MODEL = asbuilt.load_robot("two-link")


def test_log_is_told_from_that_of_other_motion() -> None:
    motion = asbuilt.random_fourier(MODEL, 1, duration=8.0)
    robot = asbuilt.VirtualRobot.preset("lab", MODEL, 1, engine="inverse-dynamics")
    log = robot.record(motion, 1, rate=200.0).recording
    check_log(MODEL, log, motion)
    sagging = replace(log, q=log.q + 0.3)
    assert np.max(measure_distance(sagging, motion)[0]) < 0.02
    other = robot.record(asbuilt.random_fourier(MODEL, 2, duration=8.0), 1, rate=200.0).recording
    with pytest.raises(RecordingError, match="not a log of the motion that was sent"):
        check_log(MODEL, other, motion)
    with pytest.raises(RecordingError, match="lasts 4 s"):
        check_log(MODEL, log.between(0.0, 4.0), motion)


def test_a_joint_that_hardly_moves_may_be_held_by_friction() -> None:
    """A soft servo does not overcome it; the log is still one of this motion."""
    motion = asbuilt.random_fourier(MODEL, 1, duration=8.0)
    t = motion.sample_times(100.0)
    sent = motion.derivative(t)
    small = sent[:, 1].mean() + (sent[:, 1] - sent[:, 1].mean()) * 0.06 / sent[:, 1].std()
    sent[:, 1] = small
    slow = SplineMotion.through(sent, t, ends="natural")
    q = sent.copy()
    q[:, 1] = small.mean()
    held = asbuilt.Recording(t=t, q=q, tau=q, joint_names=MODEL.joint_names)
    distance, size = measure_distance(held, slow)
    assert 0.4 * size[1] < distance[1]
    check_log(MODEL, held, slow)


def test_log_may_begin_before_the_motion_and_end_after_it() -> None:
    motion = asbuilt.random_fourier(MODEL, 1, duration=8.0)
    t = np.arange(0.0, 14.0, 0.01)
    q = motion.derivative(np.clip(t - 3.0, 0.0, motion.duration))
    log = asbuilt.Recording(t=t, q=q, tau=q, joint_names=MODEL.joint_names)
    assert np.max(measure_distance(log, motion)[0]) < 0.01


@pytest.mark.study
def test_design_for_a_purpose_predicts_it_better_than_a_general_one() -> None:
    """The variance of the torque on a slow motion, computed from the columns anew."""
    base = asbuilt.find_base_parameters(MODEL, DriveSet.parse("viscous,coulomb,offset"))
    usual = asbuilt.random_fourier(MODEL, 5, duration=20.0, fraction=0.3)
    states = usual.at(np.linspace(0.0, 20.0, 200))

    def information(*motion: np.ndarray) -> np.ndarray:
        rows = asbuilt.observation_matrix(MODEL, *motion, drive=base.drive, columns=base.columns)
        return rows.T @ rows

    matters = information(*states) / 200
    options = DesignOptions(duration=6.0, starts=4, size=4)
    costs = []
    for purpose in (None, matters):
        design = asbuilt.design_motion(
            MODEL, options, base=base, purpose=purpose, with_bound=False, cores=1
        )
        moved = design.motion.at(design.motion.sample_times(100.0))
        costs.append(np.trace(matters @ np.linalg.inv(information(*moved))))
    assert costs[1] < costs[0]
