"""Presliding friction against its differential equation, and its two limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from asbuilt.identification.effects.families.presliding import presliding_column

T = np.linspace(0.0, 4.0, 4001)


def position(t: np.ndarray) -> np.ndarray:
    return np.asarray(0.2 * np.sin(3.0 * t) + 0.02 * np.sin(14.0 * t))


def velocity(t: float) -> float:
    return float(0.6 * np.cos(3.0 * t) + 0.28 * np.cos(14.0 * t))


@pytest.mark.parametrize("length", [0.005, 0.03])
def test_it_solves_dahls_equation(length: float) -> None:
    def rate(t: float, z: np.ndarray) -> np.ndarray:
        return np.asarray((velocity(t) - abs(velocity(t)) * z) / length)

    exact = solve_ivp(rate, (0.0, 4.0), [0.0], t_eval=T, rtol=1e-9, atol=1e-10, max_step=1e-3)
    found = presliding_column(position(T), length)
    # Between samples the path may turn: it differs by the square of a step at a reversal.
    np.testing.assert_allclose(found, exact.y[0], atol=1e-3)


def test_short_bristles_slide_and_long_ones_are_springs() -> None:
    q = position(T)
    sliding = presliding_column(q, 1e-5)
    speed = np.array([velocity(t) for t in T])
    moving = (np.abs(speed) > 0.05) & (T > 0.0)
    np.testing.assert_allclose(sliding[moving], np.sign(speed[moving]), atol=1e-6)
    np.testing.assert_allclose(presliding_column(q, 1e5), (q - q[0]) / 1e5, rtol=1e-4, atol=1e-9)


def test_a_pause_changes_nothing() -> None:
    plain = presliding_column([0.0, 0.01, 0.02, 0.03], 0.02)
    paused = presliding_column([0.0, 0.01, 0.02, 0.02, 0.02, 0.03], 0.02)
    np.testing.assert_allclose(paused[[0, 1, 2, 5]], plain)
    np.testing.assert_allclose(paused[3:5], plain[2])
