from dataclasses import replace

import numpy as np
import pytest

from asbuilt.dynamics.reactions import Reactions
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Samples, hold_out
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter


def made(seconds=60.0, rate=100.0, parallel=None, segments=()):
    t = 7.0 + np.arange(round(seconds * rate)) / rate
    tau = np.random.default_rng(0).normal(size=(t.size, 2))
    return Samples(
        t,
        tau,
        tau,
        tau,
        tau,
        rate=rate,
        joint_names=("a", "b"),
        parallel=parallel,
        segments=segments,
    )


def test_blocks_partition_the_samples_and_every_third_is_held():
    samples = made()
    train, held = hold_out(samples, "blocks:5s:3")
    assert sorted([*train.t, *held.t]) == samples.t.tolist()
    assert held.segments == ((0, 500), (500, 1000), (1000, 1500), (1500, 2000))
    np.testing.assert_allclose(held.t[[0, 499, 500]] - 7.0, [10.0, 14.99, 25.0])
    assert [b - a for a, b in train.segments] == [1000] * 4


def test_blocks_count_from_where_the_recording_began_whatever_was_trimmed():
    whole = made()
    trimmed = whole.between(7.8, 60.0)
    assert trimmed.origin == 7.0
    np.testing.assert_allclose(hold_out(trimmed, "blocks:5s:3")[1].t[0], 17.0)


def test_last_holds_the_last_share():
    train, held = hold_out(made(), "last:0.3")
    assert (train.n_samples, held.n_samples) == (4200, 1800)
    assert train.t[-1] < held.t[0]


def test_no_held_out_torque_reaches_the_training_rows():
    samples = made(parallel=design_parallel_filter(4.0, 100.0, 5))
    train, held = hold_out(samples, "blocks:5s:3")
    poisoned = np.where(np.isin(samples.t, held.t)[:, None], 1e9, samples.tau)
    other, _ = hold_out(
        Samples(
            samples.t,
            poisoned,
            poisoned,
            poisoned,
            poisoned,
            rate=100.0,
            joint_names=("a", "b"),
            parallel=samples.parallel,
        ),
        "blocks:5s:3",
    )
    np.testing.assert_array_equal(other.filtered_torque, train.filtered_torque)
    assert (
        np.min(np.abs(train.filtered_times[:, None] - held.t[None, ::500]))
        > samples.parallel.margin / 100.0 - 1e-9
    )


@pytest.mark.parametrize(
    "rule",
    [
        "blocks",
        "blocks:5s",
        "blocks:5s:1",
        "blocks:0s:3",
        "blocks:5s:2.5",
        "blocks:fives:3",
        "blocks:5s:nan",
        "blocks:infs:3",
        "last:nan",
        "last",
        "last:1.5",
        "last:x",
        "blocks:5s:99999999999999999999",
        "blocks:1e-300s:3",
        "blocks:1e300s:3",
        "first:0.3",
        "",
    ],
)
def test_unreadable_rules_name_the_forms(rule):
    with pytest.raises(UsageError, match=r"blocks:5s:3 \(every third 5 s block\) or last:0.3"):
        hold_out(made(), rule)


def test_a_recording_too_short_for_the_rule_is_refused():
    with pytest.raises(RecordingError, match="leaves nothing to validate on"):
        hold_out(made(seconds=8.0), "blocks:5s:3")


def test_selections_keep_segments_apart():
    samples = made(1.0, segments=((0, 40), (40, 100)))
    picked = samples.between(7.1, 7.9)
    assert picked.segments == ((0, 30), (30, 80))
    assert samples.outside([(7.2, 7.3)]).segments == ((0, 20), (20, 30), (30, 90))
    with pytest.raises(RecordingError, match="no sample is left"):
        samples.between(100.0, 101.0)
    with pytest.raises(UsageError, match="one truth value for each of 100 samples"):
        samples.select(np.ones(3, bool))
    with pytest.raises(RecordingError, match="ordered index ranges"):
        made(1.0, segments=((0, 50), (40, 100)))


def test_reactions_are_those_of_the_samples_that_stay():
    closed = np.arange(100.0)[:, None]
    samples = made(1.0, segments=((0, 40), (40, 100)))
    samples = replace(samples, reactions=Reactions(closed))
    picked = samples.outside([(7.2, 7.3)])
    kept = picked.reactions.contact
    assert kept is not None
    np.testing.assert_allclose(kept[:, 0] / 100.0, picked.t - samples.t[0], atol=1e-12)
    with pytest.raises(RecordingError, match="reactions are known at 99 times"):
        replace(samples, reactions=Reactions(closed[:-1]))


def test_shared_parts_are_segments_of_one_memory_with_the_same_filtered_torques():
    whole = made(parallel=design_parallel_filter(4.0, 100.0, 5), segments=((0, 2300), (2400, 6000)))
    for own, shared in zip(
        hold_out(whole, "blocks:5s:3"), hold_out(whole, "blocks:5s:3", shared=True), strict=True
    ):
        assert np.shares_memory(shared.q, whole.q)
        assert not np.shares_memory(own.q, whole.q)
        np.testing.assert_array_equal(shared.filtered_torque, own.filtered_torque)
        np.testing.assert_array_equal(shared.filtered_times, own.filtered_times)
        np.testing.assert_array_equal(shared.compact().tau, own.tau)
        np.testing.assert_array_equal(shared.in_segments(shared.t), own.t)
        assert shared.duration == own.duration
        spans = list(shared.spans())
        assert sum(span.stop - span.start for span in spans) == own.n_samples
