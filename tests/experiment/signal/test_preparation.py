"""One motion, filtered once, for every torque and delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, SignalChain, prepare_samples, simulate_recording
from asbuilt.experiment.signal.filter_plan import FilterPlan
from asbuilt.experiment.signal.preparation import MotionFilters, stream_samples
from asbuilt.workflow import StudyOptions, identify

W = 2.0 * np.pi * np.array([0.4, 1.3])
FIELDS = ("t", "q", "qd", "qdd", "tau", "tau_raw")


def logged(kind: str) -> Recording:
    """Return a log with a uniform clock, an irregular one, or gaps, one short enough to bridge."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 40.0, 0.01)
    if kind == "irregular":
        t = np.cumsum(rng.uniform(0.007, 0.013, 4000))
    if kind == "gaps":
        t = t[(np.abs(t - 12.0) > 0.025) & (np.abs(t - 25.0) > 0.4)]
    q = np.sin(np.outer(t, W)) + 1e-5 * rng.standard_normal((t.size, 2))
    return Recording(t=t, q=q, qd=W * np.cos(np.outer(t, W)), tau=np.cos(np.outer(t, W)))


def chunks(recording: Recording) -> list[Recording]:
    return [recording.between(begin, begin + 20.0) for begin in (0.0, 20.0)]


@pytest.mark.parametrize("kind", ["uniform", "irregular", "gaps"])
def test_another_torque_gives_the_samples_of_a_recording_with_it(kind: str) -> None:
    recording, chain = logged(kind), SignalChain(cutoff=6.0)
    other = np.cumsum(np.random.default_rng(1).standard_normal(recording.tau.shape), axis=0)
    found = MotionFilters().prepare(recording, chain).with_torque(other).samples()
    whole = prepare_samples(replace(recording, tau=other), chain)
    assert found.segments == whole.segments
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


def test_a_joint_without_torque_has_none_whatever_passes_by_the_motion() -> None:
    recording, chain = logged("uniform"), SignalChain(cutoff=6.0)
    mute, other = np.array(recording.tau), np.roll(recording.tau, 1, axis=1)
    mute[:, 0] = other[:, 1] = np.nan
    silent = replace(recording, tau=mute)
    motion, whole = MotionFilters().prepare(silent, chain), prepare_samples(silent, chain)
    for found, has_torque in (
        (motion.samples(), [False, True]),
        (motion.with_torque(other).samples(), [True, False]),
        *((part, [False, True]) for part in stream_samples(chunks(silent), chain)),
    ):
        assert found.has_torque.tolist() == has_torque
        assert found.clock_bound == pytest.approx(whole.clock_bound, abs=1e-3)
        assert np.all(np.isfinite(found.tau))
    np.testing.assert_array_equal(
        motion.with_torque(other).samples().tau,
        prepare_samples(replace(recording, tau=other), chain).tau,
    )


@pytest.mark.parametrize("delay", [0.0137, -0.004, (0.02, -0.01)])
def test_a_delay_moves_the_torque_and_nothing_else(delay: float | tuple[float, ...]) -> None:
    motion = MotionFilters().prepare(logged("uniform"), SignalChain(cutoff=6.0))
    plain, late = motion.samples(), motion.samples(delay)
    for name in ("t", "q", "qd", "qdd"):
        np.testing.assert_array_equal(getattr(late, name), getattr(plain, name))
    exact = np.cos((late.t[:, None] + np.array(delay)) * W)
    np.testing.assert_allclose(late.tau_raw, exact, rtol=0, atol=2e-4)


def test_samples_whose_torque_was_not_logged_are_left_out() -> None:
    recording = logged("uniform")
    motion = MotionFilters().prepare(recording, SignalChain(cutoff=6.0, parallel=False))
    for delay, first, last in ((-0.9, 0.9, 0.0), (0.9, 0.0, 0.9)):
        samples = motion.samples(delay)
        assert samples.t[0] >= recording.t[0] + first
        assert samples.t[-1] <= recording.t[-1] - last


@pytest.mark.parametrize("delay", ["auto", 0.01])
def test_a_study_filters_the_motion_of_a_recording_once(
    monkeypatch: pytest.MonkeyPatch, delay: float | str
) -> None:
    model, filtered = bundled_robot("two-link"), []
    motion = FilterPlan.motion

    def counted(plan, segment):
        filtered.append(segment)
        return motion(plan, segment)

    monkeypatch.setattr(FilterPlan, "motion", counted)
    log = simulate_recording(model, random_fourier(model, rng=1, duration=12.0), rng=1)
    chain = SignalChain(delay=delay)  # type: ignore[arg-type]
    identify(model, log, options=StudyOptions(chain=chain, method="wls"))
    assert len(filtered) == 1


@pytest.mark.parametrize("cutoff", [8.0, 28.0])
def test_what_a_touch_down_spreads_to_is_closed(cutoff: float) -> None:
    """A body falls evenly and stops at once, where its contact closes."""
    t = np.arange(0.0, 8.0, 0.002)
    q = np.maximum(4.0 - t, 0.0)[:, None]
    recording = Recording(t=t, q=q, tau=np.ones_like(q), contact=(q <= 0.0).astype(float))
    samples = prepare_samples(recording, SignalChain(cutoff=cutoff, rests=True))
    closed = samples.reactions.contact
    assert closed is not None
    acceleration, is_open = np.abs(samples.qdd[:, 0]), closed[:, 0] == 0.0
    assert acceleration.max() > 10.0
    assert acceleration[is_open].max() < 1e-6
    assert samples.t[is_open].max() > 4.0 - 0.55 / cutoff - 0.01


@pytest.mark.parametrize("changes", [True, False])
def test_noise_of_a_pose_is_that_of_the_filtered_accelerations(changes: bool) -> None:
    t = np.arange(0.0, 60.0, 0.002)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((t.size, 8))
    contact = (np.sin(t) > 0.0)[:, None] * float(changes)
    recording = Recording(t=t, q=noise, tau=np.ones_like(noise), contact=contact)
    samples = prepare_samples(recording, SignalChain(cutoff=8.0, rests=True))
    assert samples.parallel is not None
    seen = samples.parallel.apply(np.ascontiguousarray(samples.qdd.T)).var(axis=1)
    assert np.mean(seen / np.array(samples.pose_noise)) == pytest.approx(1.0, abs=0.08)
