"""Torques shifted back by a delay, whole or in chunks."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.errors import UsageError
from asbuilt.experiment import Recording, SignalChain, prepare_samples
from asbuilt.experiment.signal.preparation import stream_samples

W = 2 * np.pi * np.array([0.7, 1.9])


def late(delay, rate=200.0, seconds=20.0) -> Recording:
    t = np.arange(round(seconds * rate)) / rate
    return Recording(
        t=t,
        q=np.sin(np.outer(t, W)),
        tau=np.cos(np.outer(t, W) - W * np.asarray(delay)),
        joint_names=("a", "b"),
        source="log",
    )


@pytest.mark.parametrize("delay", [0.01, -0.0137, (0.0031, -0.02), (0.0, 0.0049)])
def test_torques_come_back_to_their_time(delay):
    samples = prepare_samples(late(delay), SignalChain(cutoff=10.0, delay=delay))
    exact = np.cos(np.outer(samples.t, W))
    np.testing.assert_allclose(samples.tau_raw, exact, rtol=0, atol=2e-4)
    np.testing.assert_allclose(samples.q, np.sin(np.outer(samples.t, W)), rtol=0, atol=2e-3)
    assert samples.delay == (delay if isinstance(delay, tuple) else (delay,))


def test_no_delay_changes_no_bit():
    one, two, three = (
        prepare_samples(late(0.01), SignalChain(cutoff=10.0, delay=delay))
        for delay in (None, "auto", 0.0)
    )
    for other in (two, three):
        np.testing.assert_array_equal(one.tau, other.tau)
        np.testing.assert_array_equal(one.t, other.t)


@pytest.mark.parametrize("delay", [0.0123, (-0.2, 0.03)])
def test_chunks_are_shifted_as_the_whole(delay):
    chain = SignalChain(
        cutoff=10.0, delay=delay, velocity="derived", standstill=(1e-9, 1e-9), decimate=None
    )
    log = late(delay, seconds=60.0)
    whole = prepare_samples(log, chain)
    chunks = [
        replace(log, t=log.t[a:b], q=log.q[a:b], tau=log.tau[a:b])
        for a, b in ((0, 3000), (3000, 7000), (7000, 12000))
    ]
    parts = list(stream_samples(chunks, chain))
    times = np.concatenate([part.filtered_times for part in parts])
    torque = np.concatenate([part.filtered_torque for part in parts])
    np.testing.assert_allclose(times, whole.filtered_times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(torque, whole.filtered_torque, rtol=0, atol=1e-9)


def test_wrong_delays_are_refused():
    for delay in ("soon", 3.0, float("nan"), (0.0, float("inf"))):
        with pytest.raises(UsageError, match="delay"):
            SignalChain(delay=delay)
    with pytest.raises(UsageError, match="one for each of 2"):
        prepare_samples(late(0.0), SignalChain(cutoff=10.0, delay=(0.1, 0.1, 0.1)))
