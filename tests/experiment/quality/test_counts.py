"""Counts of encoders: those that torques show, those of gears, and those that they leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording, simulate_recording
from asbuilt.findings import Finding

ROBOT = load_robot("two-link")


@pytest.fixture(scope="module")
def radians() -> Recording:
    motion = random_fourier(ROBOT, rng=3, duration=20.0, n_harmonics=5)
    return simulate_recording(ROBOT, motion, rate=100.0)


def of_counts(radians: Recording, turn: float, *notes: str) -> Finding:
    counts = np.round(radians.q / (2.0 * np.pi) * turn)
    log = replace(radians, q=counts, qd=None, notes=notes)
    (finding,) = [each for each in check_recording(ROBOT, log).errors if "position" in each.code]
    return finding


def sheet_of(finding: Finding) -> dict[str, str]:
    assert finding.cure is not None
    return dict(finding.cure.sheet)


@pytest.mark.parametrize("turn", [8192, 360_000, 2**20])
def test_usual_counts_are_named_with_their_unit(radians: Recording, turn: int) -> None:
    assert sheet_of(of_counts(radians, turn)) == {"units": {"position": f"1/{turn} turn"}}


def test_a_wrap_says_where_a_turn_ends(radians: Recording) -> None:
    for turn in (4096, 36_000):
        found = of_counts(
            radians, turn, f"positions that wrap at {turn} were unwrapped: j1 2 times"
        )
        assert sheet_of(found) == {"units": {"position": f"1/{turn} turn"}}


def test_counts_of_a_gear_are_none_of_those_known(radians: Recording) -> None:
    """A turn that is near none of the usual ones is not taken for one."""
    found = of_counts(radians, 101 * 4096)
    assert not sheet_of(found)
    assert "of a turn" in found.message
