"""The sign of a base tilt is that of the world, on logs whose torque Pinocchio computes.

A base turned by +3 deg about x of the world has gravity `R^T g` in its own axes, and reads +3 deg
about x wherever a tilt is reported.
"""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from pinocchio_oracle import pinocchio_model

from asbuilt.description import load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording
from asbuilt.workflow import Study, identify

pin = pytest.importorskip("pinocchio")
pytestmark = pytest.mark.study

DEGREES = 3.0
CLOSE = 0.5
"""What a tilt may be off [deg]: the log is noisy, and masses are free within CAD."""
AXES = ("x", "y")


@cache
def study(axis: int, effects: str = "auto") -> Study:
    """Identify an arm whose base is turned about an axis of the world."""
    model = load_robot("kuka-iiwa7-r800")
    turn = pin.exp3(np.deg2rad(DEGREES) * np.eye(3)[axis])
    engine = pinocchio_model(model)
    engine.gravity.linear = turn.T @ np.array([0.0, 0.0, -9.81])
    data = engine.createData()
    move = random_fourier(model, rng=1, duration=30.0, n_harmonics=12).sample(100.0)
    states = zip(move.q, move.qd, move.qdd, strict=True)
    tau = np.array([pin.rnea(engine, data, *state) for state in states])
    tau += 1.0 * move.qd + 2.0 * np.sign(move.qd)
    tau += 0.3 * np.random.default_rng(0).normal(size=tau.shape)
    log = Recording(
        t=move.t, q=move.q, tau=tau, joint_names=model.joint_names, torque_source="sensor"
    )
    return identify(model, log, effects=effects)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_effect_reads_as_the_world(axis: int) -> None:
    (found,) = (each for each in study(axis).effects if each.effect == "tilt")
    angles = {
        name: float(value) for value, name in re.findall(r"([-+][\d.]+) about ([xy])", found.text)
    }
    assert angles[AXES[axis]] == pytest.approx(DEGREES, abs=CLOSE)
    assert angles[AXES[1 - axis]] == pytest.approx(0.0, abs=CLOSE)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_attribution_reads_as_the_world(axis: int) -> None:
    for effects, where in (("find", "Not in the model"), ("auto", "Corrected in this result")):
        attribution = study(axis, effects).attribution
        assert attribution is not None
        (sentence,) = (each for each in attribution.findings if "base tilt" in each)
        assert sentence.startswith(where)
        (found,) = (each for each in study(axis, effects).effects if each.effect == "tilt")
        assert found.text in sentence
