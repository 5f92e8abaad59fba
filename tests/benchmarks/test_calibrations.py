"""95 % intervals of gains and delays hold the truth, which other engines computed."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

from calibrations import Setting, delay_errors, gain_errors

LEAST = 0.93
"""Least share of 95 % intervals with the truth."""


def held(pairs) -> tuple[np.ndarray, float]:
    """Return which intervals hold the truth, and the RMS error in standard errors."""
    z = np.concatenate([error / std_error for error, std_error in pairs])
    known = z[np.isfinite(z)]
    assert known.size > 0.8 * z.size
    return np.abs(known) < 1.959964, float(np.sqrt(np.mean(known**2)))


@pytest.mark.study
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_delays_hold_the_truth(engine) -> None:
    parts = [
        held(delay_errors(setting, 25, engine))
        for setting in (
            Setting("two-link", 20.0),
            Setting("ur10e", 10.0, rate=125.0),
            Setting("ur10e", 30.0, rate=500.0, counts=2.0**13),
            Setting("ur10e", 10.0, noise=0.3, correlation_time=0.5),
        )
    ]
    assert np.mean(np.concatenate([inside for inside, _ in parts])) >= LEAST
    assert all(0.3 < spread < 1.3 for _, spread in parts)


@pytest.mark.study
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_gains_hold_the_truth(engine) -> None:
    parts = [
        held(gain_errors(setting, 20, engine))
        for setting in (
            Setting("ur10e", 20.0),
            Setting("kuka-iiwa7-r800", 30.0, noise=0.3, correlation_time=0.5),
            Setting("ur10e", 40.0, rate=500.0, counts=2.0**14),
        )
    ]
    assert np.mean(np.concatenate([inside for inside, _ in parts])) >= LEAST
    assert all(0.3 < spread < 1.3 for _, spread in parts)


def test_a_short_log_holds_its_delay() -> None:
    """Ten seconds, whose residuals the base parameters absorb."""
    inside, spread = held(delay_errors(Setting("two-link", 10.0, rate=125.0), 8))
    assert np.mean(inside) > 0.8
    assert spread < 1.5
