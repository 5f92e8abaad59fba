"""Figures of rollouts: errors as built are visible beside a simulation that diverges."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.writers.reports.sections.prediction import CUT, _draw_joint


def heights(pieces: list[str]) -> Array:
    """Return the heights of all points of the lines of some windows."""
    return np.array([float(point.split(",")[1]) for each in pieces for point in each.split()])


def drawn(cad: float, as_built: float) -> tuple[str, dict[str, Array]]:
    """Return the caption's errors, and the heights of the errors of both simulations."""
    q = np.sin(np.linspace(0.0, 3.0, 80)).reshape(2, 40, 1)
    ramp = np.linspace(0.0, 1.0, 40)[None, :, None]
    windows: Any = SimpleNamespace(q=q, n_windows=2, horizon=1.0)
    motion = SimpleNamespace(windows=windows, cad=q + cad * ramp, as_built=q + as_built * ramp)
    rollout: Any = SimpleNamespace(motions=[motion])
    _, lines, extent, said = _draw_joint("elbow", rollout, 0, "rad")
    assert extent == "0 to 1 rad"
    return said, dict(
        zip(("CAD", "as built"), (heights(each[2]) for each in lines[3:]), strict=True)
    )


@pytest.mark.parametrize("cad", [0.05, 60.0])
def test_errors_as_built_are_visible_beside_those_by_cad(cad: float) -> None:
    said, errors = drawn(cad, 0.02)
    by_cad = "50 mrad" if cad < 1.0 else "60 rad"
    assert said == f"20 mrad as built, {by_cad} by CAD"
    middle, top = 210.0, 172.0
    assert errors["CAD"].min() == pytest.approx(top, abs=0.1)
    share = 0.02 / min(cad, CUT * 0.02)
    assert errors["as built"].min() == pytest.approx(middle - share * (middle - top), abs=0.1)
