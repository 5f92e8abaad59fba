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


@pytest.fixture(scope="module")
def noisy(radians: Recording) -> Recording:
    """As of a robot with wrong masses: torques do not tell 4096 counts of a turn from 3600."""
    noise = np.random.default_rng(1).normal(size=radians.tau.shape)
    return replace(radians, tau=radians.tau + 0.4 * np.std(radians.tau, axis=0) * noise)


def of_counts(log: Recording, turn: float, *notes: str, velocity: float | None = None) -> Finding:
    """Find what is said of positions in counts, with velocities in a unit or without any."""
    counts = np.round(log.q / (2.0 * np.pi) * turn)
    assert log.qd is not None
    qd = None if velocity is None else log.qd / velocity
    counted = replace(log, q=counts, qd=qd, notes=notes)
    (found,) = [e for e in check_recording(ROBOT, counted).errors if "position" in e.code]
    return found


def sheet_of(finding: Finding) -> dict[str, str]:
    assert finding.cure is not None
    return dict(finding.cure.sheet)


@pytest.mark.parametrize("turn", [8192, 360_000, 2**20])
def test_usual_counts_are_named_with_their_unit(radians: Recording, turn: int) -> None:
    assert sheet_of(of_counts(radians, turn)) == {"units": {"position": f"1/{turn} turn"}}


def test_counts_that_torques_do_not_tell_apart_are_both_named(noisy: Recording) -> None:
    found = of_counts(noisy, 4096)
    assert not sheet_of(found)
    assert "3600" in found.message
    assert "4096" in found.message


def test_a_wrap_says_where_a_turn_ends(noisy: Recording) -> None:
    for turn in (3600, 4096):
        found = of_counts(noisy, turn, f"positions that wrap at {turn} were unwrapped: j1 2 times")
        assert sheet_of(found) == {"units": {"position": f"1/{turn} turn"}}


@pytest.mark.parametrize("unit", [1.0, np.pi / 180.0, np.pi / 30.0])
@pytest.mark.parametrize("turn", [3600, 4096])
def test_velocities_count_the_turn(noisy: Recording, turn: int, unit: float) -> None:
    found = of_counts(noisy, turn, velocity=unit)
    assert sheet_of(found) == {"units": {"position": f"1/{turn} turn"}}


def test_counts_of_a_gear_are_none_of_those_known(radians: Recording) -> None:
    """A turn that is near none of the usual ones is not taken for one."""
    found = of_counts(radians, 101 * 4096)
    assert not sheet_of(found)
    assert "of a turn" in found.message
