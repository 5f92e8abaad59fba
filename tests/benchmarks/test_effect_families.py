"""Every family of the benchmark of effects acts, and a number names one robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

import effects
from asbuilt.excitation import random_fourier
from effect_score import Row
from effects import (
    FAMILIES,
    MAKES,
    case,
    described,
    drawn_robot,
    felt,
    hidden_from_fit,
    read_rows,
    rows,
)

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


def test_a_file_of_rows_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def measured(number: int, families: tuple[str, ...]) -> Row:
        asked.append(number)
        return Row(number, "scara", errors={"none": 0.01})

    monkeypatch.setattr(effects, "measured", measured)
    path = tmp_path / "new" / "rows.jsonl"
    assert [row.robot for row in rows(range(2), (), 1, path)] == [0, 1]
    assert [row.robot for row in rows(range(4), (), 1, path)] == [0, 1, 2, 3]
    assert asked == [0, 1, 2, 3]
    assert sorted(read_rows(path)) == [0, 1, 2, 3]


@pytest.mark.study
def test_a_number_names_one_robot() -> None:
    one, two = case(10), case(10)
    assert one.truth == two.truth
    np.testing.assert_array_equal(one.log.tau, two.log.tau)
    assert not np.array_equal(one.log.q[:100], one.other.q[:100])
