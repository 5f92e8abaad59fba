"""Vector sine and cosine against the C library."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.compilation import kernel
from asbuilt.dynamics.kernels.lanes import LANES, LARGEST_ANGLE
from asbuilt.dynamics.kernels.recursion import BLOCK, trigonometry


@kernel("F1")
def write_cosine_and_sine(rows):
    trigonometry(rows, 0, BLOCK, 2 * BLOCK)


def sine_and_cosine(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    found = []
    for block in angles.reshape(-1, BLOCK):
        rows = np.concatenate([block, np.zeros(2 * BLOCK)])
        write_cosine_and_sine(rows)
        found.append(rows[BLOCK:].reshape(2, BLOCK))
    cosine, sine = np.concatenate(found, axis=1)
    return sine, cosine


@pytest.mark.parametrize("reach", [0.1, 4.0, 100.0, LARGEST_ANGLE, 1e3 * LARGEST_ANGLE, 1e300])
def test_two_units_in_the_last_place(reach):
    angles = np.random.default_rng(3).uniform(-reach, reach, 64 * BLOCK)
    for found, exact in zip(sine_and_cosine(angles), (np.sin(angles), np.cos(angles)), strict=True):
        assert np.all(np.abs(found - exact) <= 2 * np.spacing(np.abs(exact)))


def test_multiples_of_a_quarter_turn_and_signed_zero():
    angles = np.concatenate([np.arange(-BLOCK, BLOCK) * (np.pi / 4), np.zeros(BLOCK)])
    sine, cosine = sine_and_cosine(angles)
    np.testing.assert_allclose(sine, np.sin(angles), rtol=4e-16, atol=1e-30)
    np.testing.assert_allclose(cosine, np.cos(angles), rtol=4e-16, atol=1e-30)


def test_one_huge_angle_leaves_its_neighbours_alone():
    angles = np.linspace(-3.0, 3.0, BLOCK)
    before = sine_and_cosine(angles)
    angles[LANES // 2] = 1e9
    after = sine_and_cosine(angles)
    others = np.arange(BLOCK) != LANES // 2
    np.testing.assert_array_equal(np.array(before)[:, others], np.array(after)[:, others])
    assert after[0][LANES // 2] == np.sin(1e9)


def test_not_a_number_stays_one():
    angles = np.zeros(BLOCK)
    angles[3] = np.nan
    sine, cosine = sine_and_cosine(angles)
    assert (
        np.flatnonzero(np.isnan(sine)).tolist() == np.flatnonzero(np.isnan(cosine)).tolist() == [3]
    )
