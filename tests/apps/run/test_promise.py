"""What a model promises on motion that it has not seen."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import asbuilt
from asbuilt.apps.run.promise import Promise, States, Unexplained, promise_error, widen_promise
from asbuilt.excitation import Motion

MODEL = asbuilt.load_robot("two-link")
RATE = 20.0
LEVEL = 0.02
"""Error [N m] in quick motion."""
CREEP = 0.1
"""Speed [rad/s] below which friction is not explained."""


def predict(motion: Motion, rng: np.random.Generator) -> Any:
    """Return a prediction with errors that grow where a joint creeps, as those of friction do."""
    t = motion.sample_times(RATE)
    velocity = motion.derivative(t, 1)
    speed = np.hypot(velocity, motion.derivative(t, 2) / RATE)
    error = (
        LEVEL * np.hypot(1.0, 10.0 / (1.0 + (speed / CREEP) ** 2)) * rng.normal(size=speed.shape)
    )
    return SimpleNamespace(t=t, velocity=velocity, error=error)


def test_unexplained_torque_is_promised_by_speed() -> None:
    """Learned from quick and slow motion, it is that of other slow motion, not the mean."""
    rng = np.random.default_rng(1)
    quick = [
        predict(asbuilt.random_fourier(MODEL, k, duration=20.0, n_harmonics=20), rng)
        for k in range(12)
    ]
    slow = [
        asbuilt.random_fourier(MODEL, 10 + k, duration=10.0, n_harmonics=10).slowed(6.0)
        for k in range(2)
    ]
    learned = [*quick, predict(slow[0], rng)]
    found = np.sqrt(np.mean(predict(slow[1], rng).error ** 2, axis=0))
    promised = Unexplained.of(learned).at(States.of([slow[1]]))
    np.testing.assert_allclose(promised / found, 1.15, atol=0.25)
    plain = np.sqrt(np.mean(np.vstack([each.error for each in learned]) ** 2, axis=0))
    assert np.all(found > 1.3 * plain)


def test_slower_groups_never_have_smaller_errors() -> None:
    rng = np.random.default_rng(2)
    motion = asbuilt.random_fourier(MODEL, 3, duration=10.0)
    even = predict(motion, rng)
    even.error = rng.normal(size=even.error.shape)
    unexplained = Unexplained.of([even])
    assert all(np.all(np.diff(squares) <= 0.0) for squares in unexplained.squares)
    assert all(np.all(np.diff(speeds) > 0.0) for speeds in unexplained.speeds)
    np.testing.assert_allclose(unexplained.at(States.of([motion])), 1.0, atol=0.25)


def test_a_joint_without_torque_promises_nothing() -> None:
    even = predict(asbuilt.random_fourier(MODEL, 3, duration=10.0), np.random.default_rng(0))
    even.error[:, 1] = np.nan
    found = Unexplained.of([even]).at(States(*np.zeros((3, 5, 2))))
    assert found[0] > LEVEL
    assert found[1] == pytest.approx(0.0)


def test_what_earlier_models_promised_or_this_one_promises_does_not_widen_it() -> None:
    """A joint that was found worse than both does; one that only the old model misjudged not."""
    recording = asbuilt.VirtualRobot.preset("lab", MODEL, 1, engine="inverse-dynamics").record(
        asbuilt.random_fourier(MODEL, 1, duration=8.0), 1, rate=200.0
    )
    study = asbuilt.identify(MODEL, [recording.recording])
    unexplained = Unexplained.of(study.training)
    states = States.of([asbuilt.random_fourier(MODEL, 2, duration=8.0)])
    now = promise_error(study.result, states, unexplained=unexplained)
    less = replace(now, noise=0.5 * now.noise, uncertain=0.5 * now.uncertain)
    more = replace(now, noise=3.0 * now.noise, uncertain=3.0 * now.uncertain)
    found = now.joints * [1.0, 2.0]

    def widen(before: Promise) -> np.ndarray | None:
        return widen_promise(study.result, unexplained, [(states, before, found)])

    np.testing.assert_allclose(widen(less), [1.0, 2.0])
    np.testing.assert_allclose(widen(now), [1.0, 2.0])
    np.testing.assert_allclose(widen(more), 1.0)
    assert widen_promise(study.result, unexplained, []) is None
