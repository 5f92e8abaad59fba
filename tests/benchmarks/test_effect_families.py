"""Every family of the benchmark of effects acts, and a number names one robot."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

from asbuilt.excitation.motions.random_motion import random_fourier
from effects import FAMILIES, MAKES, case, described, drawn_robot, felt, hidden_from_fit

VISIBLE = (
    *("tilt", "spring", "cable", "stribeck", "quadratic", "load_friction", "coupling", "delay"),
    *("presliding", "elastic"),
)
"""Families that no parameter of the model imitates wholly."""


@pytest.mark.parametrize("family", FAMILIES)
def test_an_effect_is_felt(family: str) -> None:
    rng = np.random.default_rng(1)
    cad = described("ur10e", 3)
    motion = random_fourier(cad, rng=rng, duration=10.0, n_harmonics=10)
    robot, facts = drawn_robot(cad, MAKES["few joints"], motion, rng)
    assert hidden_from_fit(robot, facts, motion) < 1e-6
    draws = [FAMILIES[family](robot, facts, rng) for _ in range(6)]
    assert max(felt(robot, changed, facts, motion) for changed, *_ in draws) > 0.05
    if family in VISIBLE:
        assert max(hidden_from_fit(changed, facts, motion) for changed, *_ in draws) > 0.01


@pytest.mark.study
def test_a_number_names_one_robot() -> None:
    one, two = case(10), case(10)
    assert one.truth == two.truth
    np.testing.assert_array_equal(one.log.tau, two.log.tau)
    assert not np.array_equal(one.log.q[:100], one.other.q[:100])
