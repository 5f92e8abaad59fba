from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, SignalChain, prepare_samples, resolve_chain
from asbuilt.experiment.signal.preparation import stream_samples

W = 2 * np.pi * np.array([0.3, 0.45])


def states(t):
    return np.sin(np.outer(t, W)), W * np.cos(np.outer(t, W)), -(W**2) * np.sin(np.outer(t, W))


def moving(rate=1000.0, seconds=30.0, noise=0.0, seed=0):
    t = np.arange(round(seconds * rate)) / rate
    rng = np.random.default_rng(seed)
    q = states(t)[0] + noise * rng.normal(size=(t.size, 2))
    return Recording(
        t=t,
        q=q,
        tau=3 * states(t)[2] + states(t)[0] + 0.1 * noise * rng.normal(size=q.shape),
        joint_names=("a", "b"),
        source="log",
    )


def test_paper2015_is_the_papers_calls_one_by_one():
    recording = moving(noise=1e-4)
    samples = prepare_samples(recording, SignalChain.preset("paper2015"))
    b, a = signal.butter(2, 7 / 500)
    q = signal.filtfilt(b, a, recording.q, axis=0)
    qd = np.gradient(q, 0.001, axis=0)
    qdd = np.gradient(qd, 0.001, axis=0)
    inside = slice(200, -200)
    for ours, theirs in (
        (samples.q, q),
        (samples.qd, qd),
        (samples.qdd, qdd),
        (samples.tau, recording.tau),
    ):
        expected = signal.decimate(theirs, 10, n=8, ftype="iir", axis=0, zero_phase=True)
        np.testing.assert_allclose(
            ours[inside], expected[inside], rtol=0, atol=1e-7 * np.abs(expected).max()
        )
    np.testing.assert_array_equal(samples.t, recording.t[::10])
    np.testing.assert_array_equal(samples.tau_raw, recording.tau[::10])
    assert samples.parallel is None
    assert samples.rate == 100.0


@pytest.mark.parametrize("rate", [100.0, 250.0, 1000.0])
@pytest.mark.parametrize("derivative", ["central", "savitzky-golay", "spline"])
def test_a_clean_motion_comes_back_without_lag_also_at_the_ends(rate, derivative):
    samples = prepare_samples(moving(rate, 20.0), SignalChain(derivative=derivative))
    for ours, exact, scale in zip(
        (samples.q, samples.qd, samples.qdd), states(samples.t), (1.0, W, W**2), strict=True
    ):
        assert np.abs(ours - exact).max() < 0.006 * np.max(scale)
        inside = slice(round(samples.rate), -round(samples.rate))
        assert np.abs(ours - exact)[inside].max() < 1.5e-3 * np.max(scale)


def test_torque_and_regressor_columns_stay_equal_through_the_parallel_filter():
    samples = prepare_samples(moving(noise=0.0), SignalChain(cutoff=6.0))
    q, _, qdd = states(samples.t)
    np.testing.assert_allclose(samples.filtered_torque, samples.filtered(3 * qdd + q), atol=2e-3)
    assert samples.filtered_times.size == samples.n_filtered == len(samples.filtered_torque)
    np.testing.assert_allclose(samples.tau_raw, 3 * qdd + q, atol=1e-9)


def test_the_cutoff_follows_the_motion_and_is_stated():
    slow = prepare_samples(moving(seconds=60.0, noise=0.0))
    stated = next(line for line in slow.provenance if "95 %" in line)
    assert "0.45 Hz" in stated or "0.5 Hz" in stated
    chain = resolve_chain(SignalChain(), moving(seconds=60.0))
    assert chain.cutoff == 7.0
    t = np.arange(0.0, 30.0, 0.002)
    q = np.sin(2 * np.pi * 1.5 * t)[:, None]
    fast = resolve_chain(SignalChain(), Recording(t=t, q=q, tau=q))
    assert fast.cutoff == pytest.approx(15.0, rel=0.1)
    assert prepare_samples(moving(100.0, 20.0), chain).parallel.cutoff == 0.5 * chain.cutoff


def test_gaps_become_segments_with_trimmed_ends():
    recording = moving(200.0, 30.0)
    recording = recording.taken((recording.t < 12) | (recording.t >= 13))
    samples = prepare_samples(recording, SignalChain(cutoff=6.0))
    assert len(samples.segments) == 2
    assert not np.any((samples.t > 11.9) & (samples.t < 13.1))
    assert np.abs(samples.qdd - states(samples.t)[2]).max() < 0.006 * W.max() ** 2


def test_rests_are_left_out_and_joints_at_rest_have_exactly_no_velocity():
    rng = np.random.default_rng(5)
    t = np.arange(0, 20, 0.005)
    s = np.clip((t - 4) / 8, 0, 1)
    q = np.column_stack(
        [
            10 * s**3 - 15 * s**4 + 6 * s**5,
            np.where(t < 8, 0, np.sin(np.maximum(t - 8, 0)) ** 2 * (t < 8 + np.pi)),
        ]
    )
    recording = Recording(t=t, q=q + 1e-6 * rng.normal(size=q.shape), tau=q, source="log")
    samples = prepare_samples(recording, SignalChain(cutoff=6.0))
    shoulder = samples.parallel.margin / samples.rate
    assert samples.t[0] > 4 - shoulder - 0.1
    assert samples.t[-1] < 12 + shoulder + 0.1
    assert np.all(samples.qd[samples.t < 7.5, 1] == 0)
    assert prepare_samples(recording, SignalChain(cutoff=6.0, rests=True)).t[0] < 0.5
    assert any("all joints are at rest" in line for line in samples.provenance)


def test_logged_velocities_are_used_when_quieter_and_in_step_only():
    recording = moving(200.0, 40.0, noise=1e-4)
    good, late = states(recording.t)[1], states(recording.t - 0.02)[1]
    used = prepare_samples(replace(recording, qd=good), SignalChain(cutoff=6.0))
    rejected = prepare_samples(replace(recording, qd=late), SignalChain(cutoff=6.0))
    assert any(line.startswith("logged velocities used") for line in used.provenance)
    assert any(
        line.startswith("logged velocities not used: they lag the positions' derivative by 20 ms")
        for line in rejected.provenance
    )
    assert (
        np.abs(used.qdd - states(used.t)[2]).max()
        < np.abs(rejected.qdd - states(rejected.t)[2]).max()
    )
    with pytest.raises(UsageError, match="the recording has none"):
        prepare_samples(recording, SignalChain(velocity="measured"))


@pytest.mark.parametrize("chunk", [4000, 7001])
@pytest.mark.parametrize("rest", [False, True])
def test_chunks_give_what_the_whole_gives(chunk, rest):
    recording = moving(500.0, 60.0, noise=1e-5)
    if rest:
        clock = recording.t - np.clip(recording.t - 20.0, 0, 5.0)
        q = states(clock)[0] + 1e-7 * np.random.default_rng(6).normal(size=(clock.size, 2))
        recording = replace(recording, q=q)
    keep = (recording.t < 31.0) | (recording.t > 31.5)
    recording = recording.taken(keep)
    chain = SignalChain(cutoff=6.0, standstill=(0.05, 0.05))
    whole = prepare_samples(recording, chain)
    parts = list(
        stream_samples(
            (recording.taken(slice(i, i + chunk)) for i in range(0, recording.n_samples, chunk)),
            chain,
        )
    )
    assert len(parts) > 3
    times = np.concatenate([part.filtered_times for part in parts])
    np.testing.assert_allclose(times, whole.filtered_times, atol=1e-9)
    for name in ("q", "qd", "qdd", "tau"):
        ours = np.concatenate([part.filtered(getattr(part, name)) for part in parts])
        expected = whole.filtered(getattr(whole, name))
        np.testing.assert_allclose(
            ours, expected, rtol=0, atol=1e-9 * np.abs(expected).max(), err_msg=name
        )


def test_chunks_keep_contacts():
    log = moving()
    closed = (np.sin(3.0 * log.t) > 0.0).astype(float)[:, None]
    log = replace(log, contact=np.hstack([closed, 1.0 - closed]))
    chain = SignalChain(cutoff=6.0, standstill=(0.05, 0.05))
    whole = prepare_samples(log, chain)
    chunks = (log.taken(slice(k, k + 900)) for k in range(0, log.n_samples, 900))
    for part in stream_samples(chunks, chain):
        same = np.searchsorted(whole.t, part.t - 1e-6)
        np.testing.assert_array_equal(part.reactions.contact, whole.reactions.contact[same])


def test_paper2015_cannot_be_streamed():
    with pytest.raises(UsageError, match="cannot process chunks"):
        list(stream_samples([moving()], SignalChain.preset("paper2015")))


def test_decimation_is_as_asked_and_lowers_the_cutoff_where_it_must():
    samples = prepare_samples(moving(1000.0), SignalChain(cutoff=6.0, decimate=40))
    assert samples.rate * 40 / 1000.0 / samples.parallel.decimation == pytest.approx(1.0)
    coarse = prepare_samples(moving(1000.0), SignalChain(cutoff=6.0, decimate=200))
    assert coarse.parallel.output_rate == pytest.approx(5.0)
    assert coarse.parallel.cutoff < 1.5
    with pytest.raises(UsageError, match="decimate by at most"):
        prepare_samples(moving(1000.0), SignalChain(cutoff=6.0, parallel_cutoff=6.0, decimate=200))


def test_wrong_options_are_refused():
    for wrong in (
        {"cutoff": -1.0},
        {"decimate": 0},
        {"derivative": "magic"},
        {"velocity": "guess"},
        {"order": 0},
    ):
        with pytest.raises(UsageError):
            SignalChain(**wrong)
    with pytest.raises(UsageError, match="paper2015"):
        SignalChain.preset("paper2016")
    with pytest.raises(RecordingError, match="longest segment without a gap has 30 samples"):
        prepare_samples(moving(100.0, 0.3), SignalChain(cutoff=3.0))
    with pytest.raises(UsageError, match="between 0 and 50 Hz"):
        prepare_samples(moving(100.0), SignalChain(cutoff=60.0))
    with pytest.raises(UsageError, match="raise the cutoff"):
        prepare_samples(moving(100.0), SignalChain(cutoff=1e-9))
    slow = moving(100.0)
    with pytest.raises(RecordingError, match="check that the time stamps are in seconds"):
        prepare_samples(replace(slow, t=slow.t * 1e9))


def test_the_shuffled_states_are_found_to_be_polled(shared):
    columns = np.loadtxt(
        shared / "data/lbr_med7/joint_states_positions.csv", delimiter=",", skiprows=1
    )
    efforts = np.loadtxt(
        shared / "data/lbr_med7/joint_states_efforts.csv", delimiter=",", skiprows=1
    )
    samples = prepare_samples(Recording(t=columns[:, 0], q=columns[:, 1:], tau=efforts[:, 1:]))
    assert samples.rate == 100.0
    assert "9044 samples that repeat" in samples.provenance[0]


def test_the_lagging_velocities_of_the_lwr_are_rejected(shared):
    with np.load(shared / "data/kuka_lwr4/measurements_1.npz") as log:
        recording = Recording(
            t=log["times"], q=log["positions"], qd=log["velocities"], tau=log["torques"]
        )
    verdict = next(
        line
        for line in prepare_samples(recording).provenance
        if line.startswith("logged velocities not used")
    )
    assert "lag the positions' derivative by 34 ms" in verdict
