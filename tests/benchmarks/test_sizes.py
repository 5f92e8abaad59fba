"""What `identify` does for robots of many joints, counted: a busy machine changes no count."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from asbuilt import identify
from asbuilt.description import load_robot
from asbuilt.dynamics import RegressorPlan
from asbuilt.experiment import read_recording
from asbuilt.identification.bodies import conic_fit
from asbuilt.identification.effects.trials import Trials
from sizes import humanoid, limbs, serial_chain

GROWTH = 1.3
"""Largest growth of a number that should not depend on the joints, when these double."""


def counted(folder: Path, links: list, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Return how often what is costly is done in identifying a robot, and what is held."""
    counts: Counter[str] = Counter()

    def evaluate(self: RegressorPlan, q, *rest, **more):
        counts["samples"] += len(q)
        return original[0](self, q, *rest, **more)

    def solve(*given, **more):
        counts["cone programs"] += 1
        return original[1](*given, **more)

    def begin(self: Trials, rows, *rest):
        counts["numbers of a column"] = sum(own.size for own in rows.rows) // sum(
            own.shape[-1] for own in rows.rows
        )
        counts["selections"] += 1
        original[2](self, rows, *rest)

    original = (RegressorPlan.evaluate, conic_fit.solve_cone_program, Trials.__init__)
    with monkeypatch.context() as patch:
        patch.setattr(RegressorPlan, "evaluate", evaluate)
        patch.setattr(conic_fit, "solve_cone_program", solve)
        patch.setattr(Trials, "__init__", begin)
        robot, log = limbs(folder, links)
        model = load_robot(robot)
        identify(model, [read_recording(log, model=model)])
    return counts


@pytest.mark.study
@pytest.mark.parametrize("robot", [humanoid, serial_chain])
def test_walks_and_programs_do_not_grow_with_the_joints(
    robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of a sample grow with the joints; how often they are made must not."""
    few, many = (tmp_path / name for name in ("few", "many"))
    few.mkdir()
    many.mkdir()
    before = counted(few, robot(15), monkeypatch)
    after = counted(many, robot(30), monkeypatch)
    assert after["selections"] == before["selections"]
    for what in ("samples", "cone programs", "numbers of a column"):
        assert 0 < after[what] <= GROWTH * before[what], (what, before, after)
