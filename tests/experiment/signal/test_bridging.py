"""Pauses shorter than the filter resolves: the motion is known, so is what was left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.experiment import Recording, SignalChain, plan_uniform_grid, prepare_samples

NOISE = 1e-5


def resampled(recording, *settings, **named):
    grid = plan_uniform_grid(recording, *settings, **named)
    return grid.uniform(), grid.rate, grid.notes


def motion(t: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(2 * np.pi * 0.5 * t), 0.3 * np.cos(2 * np.pi * 1.1 * t)], axis=1)


def recording(rate: float = 1000.0, pauses: int = 12, missing: int = 30) -> Recording:
    rng = np.random.default_rng(3)
    t = np.arange(round(20 * rate)) / rate
    keep = np.ones(t.size, dtype=bool)
    for start in np.linspace(1.0, 19.0, pauses):
        keep[round(start * rate) : round(start * rate) + missing] = False
    t = t[keep]
    q = motion(t) + NOISE * rng.normal(size=(t.size, 2))
    return Recording(t=t, q=q, tau=10 * motion(t) + 0.1 * rng.normal(size=q.shape))


def test_what_is_bridged_is_as_good_as_what_was_logged() -> None:
    (run,), rate, notes = resampled(recording(), None, None, 0.25 / 7.0)
    assert rate == 1000.0
    assert run.t.size == 20_000
    assert np.abs(run.q - motion(run.t)).max() < 8 * NOISE
    assert np.abs(run.tau - 10 * motion(run.t)).max() < 0.6
    assert any("12 pauses of up to 0.031 s" in note for note in notes)


def test_chain_bridges_what_its_cutoff_does_not_resolve() -> None:
    log = recording()
    slow, fast = (prepare_samples(log, SignalChain(cutoff=c)) for c in (7.0, 20.0))
    assert len(slow.segments) == 1
    assert len(fast.segments) == 13
    acceleration = -((2 * np.pi * 0.5) ** 2) * np.sin(2 * np.pi * 0.5 * slow.t)
    assert np.abs(slow.qdd[:, 0] - acceleration).max() < 0.02 * np.abs(acceleration).max()
    assert len(prepare_samples(log, SignalChain(cutoff=7.0, max_gap=0.01)).segments) == 13
    assert len(prepare_samples(log, SignalChain(cutoff=20.0, max_gap=0.05)).segments) == 1


@pytest.mark.parametrize("missing", [1, 3])
def test_single_lost_samples_of_a_slow_log_leave_one_segment(missing: int) -> None:
    samples = prepare_samples(recording(100.0, 40, missing), SignalChain(cutoff=5.0))
    assert len(samples.segments) == 1
    acceleration = -((2 * np.pi * 0.5) ** 2) * np.sin(2 * np.pi * 0.5 * samples.t)
    assert np.abs(samples.qdd[:, 0] - acceleration).max() < 0.03 * np.abs(acceleration).max()


def test_logged_velocities_and_accelerations_are_bridged_alike() -> None:
    log = recording()
    rates = 2 * np.pi * np.array([0.5, 1.1])
    qd = np.stack([np.cos(rates[0] * log.t), -0.3 * np.sin(rates[1] * log.t)], axis=1) * rates
    qdd = -motion(log.t) * rates**2
    logged = replace(log, qd=qd, qdd=qdd, undriven=log.joint_names)
    (run,), _, _ = resampled(logged, None, None, 0.25 / 7.0)
    assert run.qd is not None
    assert run.qdd is not None
    assert np.abs(run.qdd + motion(run.t) * rates**2).max() < 1e-5
    assert np.abs(run.qd[:, 0] - rates[0] * np.cos(rates[0] * run.t)).max() < 1e-6
