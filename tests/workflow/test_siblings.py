"""A sibling as prior: robots whose torque Pinocchio computes, and a log too short for a fit."""

import json

import numpy as np
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))

from asbuilt import identify, load_robot, validate
from asbuilt.description.sibling import Sibling
from asbuilt.excitation import random_fourier
from outside_robot import OutsideRobot, Sensors, other_bodies


@pytest.mark.study
def test_a_short_log_predicts_other_motion_better_with_a_sibling(tmp_path) -> None:
    """Two robots of a type are 1 % apart, the description 30 % from both."""
    cad = load_robot("two-link")
    rng = np.random.default_rng(5)
    built = other_bodies(cad, rng, mass=0.3, centre=0.3, shape=0.3)
    sibling, own = (other_bodies(built, rng, mass=0.01, centre=0.01, shape=0.01) for _ in "ab")
    page = tmp_path / "page.json"
    page.write_text(json.dumps(Sibling.of(sibling).as_dict()))
    n = cad.n_joints
    robot = OutsideRobot(own, *np.full((3, n), 1e-3), armature=np.zeros(n))
    short, other = (
        robot.log(
            random_fourier(cad, rng=rng, duration=duration, n_harmonics=5),
            Sensors(np.full(n, noise), turns=(True,) * n),
            100.0,
            rng,
        )
        for duration, noise in ((4.0, 1.0), (20.0, 1e-6))
    )
    error = {}
    for prior in (None, page):
        study = identify(cad, short, effects="none", method="entropic", siblings=prior)
        (found,) = validate(study, other)
        error[prior] = found.metrics_as_built.relative_error
    assert error[page] < 0.7 * error[None]
