"""Robots that are built as designed: what is said to differ does so by chance, and seldom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot
from asbuilt.workflow import Study, StudyOptions, identify


def study_of_a_robot_as_designed(name: str, seed: int) -> Study:
    """Sensors, friction and tracking errors of the lab; the bodies are those of the description."""
    robot = VirtualRobot.preset("lab", bundled_robot(name), rng=seed)
    robot = replace(robot, model=robot.described)
    recording = robot.record(
        random_fourier(robot.model, 1000 + seed, duration=30.0), rng=seed
    ).recording
    return identify(
        robot.described, [recording], options=StudyOptions(holdout="blocks:2s:3", method="wls")
    )


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "ur10e", "scara"])
@pytest.mark.study
def test_few_parameters_differ_and_none_matters(name: str) -> None:
    studies = [study_of_a_robot_as_designed(name, seed) for seed in range(2)]
    found = [study.comparison for study in studies]
    assert sum(each.n_differing for each in found) <= 0.05 * sum(each.n_compared for each in found)
    assert all(each.n_mattering == 0 for each in found)
    sigmas = np.array(
        [
            parameter.sigmas
            for each in found
            for parameter in each.parameters
            if parameter.sigmas is not None
        ]
    )
    assert 0.4 < np.sqrt(np.mean(sigmas**2)) < 1.2
    for study in studies:
        assert study.attribution is not None
        assert set(study.attribution.chosen) <= {"offset", "friction", "armature"}
        assert "tilt" not in {each.effect for each in study.effects}
