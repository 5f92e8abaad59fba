"""Square-root information against the observation matrix of the whole recording, stacked and solved
at once.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, RegressorPlan, find_base_parameters, observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import Recording, Samples, SignalChain, prepare_samples
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.experiment.signal.preparation import stream_samples
from asbuilt.identification import (
    EstimationData,
    FurtherColumns,
    GrowingFactor,
    Rows,
    SquareRootInformation,
    TimeBlock,
    accumulate_stream,
    fit_least_squares,
    reduce_rows,
    solve_factor,
    triangular_factor,
)
from asbuilt.identification.information import rows as rows_module
from asbuilt.identification.information import square_root_information
from asbuilt.identification.information.rows import KeptRows, divide_into_blocks
from asbuilt.identification.information.square_root_information import MOST_BLOCKS, accumulate
from asbuilt.identification.uncertainty.pose_noise import MeanScores
from studied_cases import first_of

DRIVE = DriveSet.parse("viscous,coulomb,offset")


@pytest.fixture(scope="module")
def robot():
    model = load_robot("kuka-iiwa7-r800")
    return model, find_base_parameters(model, DRIVE)


def recording(model, n_samples=1500, rate=100.0, seed=1, source="bench", **given):
    rng = np.random.default_rng(seed)
    n = model.n_joints
    q, qd, qdd = rng.uniform(-2, 2, (3, n_samples, n))
    tau = rng.normal(scale=5.0, size=(n_samples, n))
    whole = {
        "t": np.arange(n_samples) / rate,
        "q": q,
        "qd": qd,
        "qdd": qdd,
        "tau": tau,
        "rate": rate,
    }
    return Samples(**(whole | {"joint_names": model.joint_names, "source": source} | given))


def joint_stacks(model, base, samples):
    whole = observation_matrix(
        model, samples.q, samples.qd, samples.qdd, drive=base.drive, columns=base.columns
    )
    cube = whole.reshape(samples.n_samples, model.n_joints, base.n_base)
    filtered, tau = samples.filtered(cube), samples.filtered_torque
    return [np.column_stack([filtered[:, k], tau[:, k]]) for k in range(model.n_joints)]


def assert_same_information(information, stacks, tolerance=1e-12):
    for k, stack in enumerate(stacks):
        columns = np.append(information.support[k], information.base.n_base)
        others = np.setdiff1d(np.arange(information.base.n_base), columns)
        assert np.all(stack[:, others] == 0)
        gram = stack[:, columns].T @ stack[:, columns]
        factor = information.joint_factors[k]
        assert np.allclose(factor.T @ factor, gram, rtol=0, atol=tolerance * np.abs(gram).max())
        assert np.array_equal(factor, np.triu(factor))


def assert_same_gram(a, b):
    assert np.allclose(a.T @ a, b.T @ b, rtol=0, atol=1e-12 * np.abs(a.T @ a).max())


def test_factors_hold_the_normal_equations_of_each_joint(robot):
    model, base = robot
    samples = recording(model)
    assert_same_information(accumulate(model, base, samples), joint_stacks(model, base, samples))


def test_parallel_filter_goes_over_every_column_segment_by_segment(robot):
    model, base = robot
    samples = recording(
        model, parallel=design_parallel_filter(8.0, 100.0, 3), segments=((0, 700), (720, 1500))
    )
    information = accumulate(model, base, samples, block_seconds=2.0)
    assert information.n_samples == samples.n_filtered
    assert_same_information(information, joint_stacks(model, base, samples))


@pytest.mark.parametrize("parallel", [None, design_parallel_filter(8.0, 100.0, 3)])
def test_torque_of_a_block_is_filtered_as_its_rows_are(robot, parallel):
    model, base = robot
    samples = recording(
        model,
        parallel=parallel,
        segments=((0, 700), (720, 1500)),
        slowest=(0.05,) * model.n_joints,
    )
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=1)
    for block in divide_into_blocks(model, [samples], 2.0):
        rows = [[joint[-1].copy() for joint in chunk] for chunk in block.chunks(plan)]
        alone = block.filtered(lambda span: samples.tau[span])
        np.testing.assert_allclose(alone, np.hstack(rows), rtol=0, atol=1e-12)
        assert np.any(alone == 0.0)


def test_a_stretch_too_short_for_the_filter_is_left_out_and_nothing_left_is_an_error(robot):
    model, base = robot
    parallel = design_parallel_filter(8.0, 100.0, 3)
    short = recording(model, 2 * parallel.margin, parallel=parallel)
    with pytest.raises(IdentifiabilityError, match="shorter than the filter needs"):
        accumulate(model, base, short)


def test_solution_is_that_of_the_full_stack(robot):
    model, base = robot
    samples = recording(model)
    stack = np.vstack(joint_stacks(model, base, samples))
    expected = np.linalg.lstsq(stack[:, :-1], stack[:, -1], rcond=None)[0]
    estimate = fit_least_squares(accumulate(model, base, samples))
    assert np.linalg.norm(estimate.beta - expected) <= 1e-11 * np.linalg.norm(expected)
    residual = stack @ np.append(-expected, 1.0)
    assert estimate.solution.residual_energy == pytest.approx(residual @ residual, rel=1e-12)
    scaled = stack[:, :-1] / np.linalg.norm(stack[:, :-1], axis=0)
    assert estimate.solution.condition_number == pytest.approx(
        np.linalg.cond(stack[:, :-1]), rel=1e-9
    )
    assert estimate.solution.scaled_condition_number == pytest.approx(
        np.linalg.cond(scaled), rel=1e-9
    )


@pytest.mark.parametrize("seed", first_of(2, range(5)))
def test_agrees_with_a_singular_value_solve_at_condition_number_a_million(seed):
    rng = np.random.default_rng(seed)
    m, p = 20000, 64
    left, _ = np.linalg.qr(rng.normal(size=(m, p)))
    right, _ = np.linalg.qr(rng.normal(size=(p, p)))
    w = left * np.geomspace(1e3, 1e-3, p) @ right.T
    tau = w @ rng.normal(size=p) + 1e-3 * rng.normal(size=m)
    growing = GrowingFactor(p + 1)
    for start in range(0, m, 777):
        growing.append(np.column_stack([w, tau])[start : start + 777].T)
    u, s, vt = np.linalg.svd(w, full_matrices=False)
    assert s[0] / s[-1] == pytest.approx(1e6, rel=1e-6)
    expected = vt.T @ ((u.T @ tau) / s)
    solution = solve_factor(growing.factor(), m)
    assert np.linalg.norm(solution.x - expected) <= 1e-9 * np.linalg.norm(expected)


def test_a_small_motion_of_a_robot_agrees_with_the_full_stack_at_condition_number_a_million(robot):
    model, base = robot
    rng = np.random.default_rng(4)
    n = model.n_joints
    samples = recording(model, 4000)
    near = replace(samples, q=0.4 + 0.05 * samples.q, qd=0.05 * samples.qd, qdd=0.1 * samples.qdd)
    stack = np.vstack(joint_stacks(model, base, near))
    w = stack[:, :-1]
    tau = w @ rng.normal(size=base.n_base) + 0.01 * rng.normal(size=len(w))
    near = replace(near, tau=tau.reshape(n, -1).T, tau_raw=np.empty((0, 0)))
    expected = np.linalg.svd(w, full_matrices=False)
    assert expected[1][0] / expected[1][-1] > 1e4
    best = expected[2].T @ ((expected[0].T @ tau) / expected[1])
    found = fit_least_squares(accumulate(model, base, near)).beta
    assert np.linalg.norm(found - best) <= 1e-9 * np.linalg.norm(best)


def test_blocks_and_threads_change_nothing_in_the_sum(robot):
    model, base = robot
    samples = recording(model)
    one = accumulate(model, base, samples, block_seconds=100.0, threads=1)
    many = accumulate(model, base, samples, block_seconds=0.7, threads=1)
    assert one.n_blocks == 1
    assert many.n_blocks == 21
    for a, b in zip(one.joint_factors, many.joint_factors, strict=True):
        assert_same_gram(a, b)
    for k, factors in enumerate(
        accumulate(model, base, samples, block_seconds=0.7, threads=3).factors
    ):
        assert np.array_equal(factors, many.factors[k])


def test_no_more_threads_than_cores_that_may_be_used(robot, monkeypatch):
    """A container may use few of a machine's cores.

    As many threads as the machine has would only hold memory.
    """
    model, base = robot
    asked = []

    class Counted(ThreadPoolExecutor):
        def __init__(self, max_workers):
            asked.append(max_workers)
            super().__init__(max_workers)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 5, 7}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(square_root_information, "ThreadPoolExecutor", Counted)
    accumulate(model, base, recording(model))
    assert asked == [3]
    with pytest.raises(UsageError, match="threads must be at least 1, got 0"):
        accumulate(model, base, recording(model), threads=0)


def test_select_and_merge_take_information_apart_and_together(robot):
    model, base = robot
    samples = recording(model)
    whole = accumulate(model, base, samples, block_seconds=1.0)
    even, odd = (
        whole.select(np.arange(whole.n_blocks) % 2 == 0),
        whole.select(range(1, whole.n_blocks, 2)),
    )
    again = even.merge(odd)
    assert again.n_samples == whole.n_samples
    for a, b in zip(again.joint_factors, whole.joint_factors, strict=True):
        assert_same_gram(a, b)
    alone = samples.between(whole.blocks[0].start, whole.blocks[0].stop + 1e-6)
    assert_same_information(whole.select([0]), joint_stacks(model, base, alone))
    twice = whole.select([0, 0])
    assert np.allclose(twice.torque_energy, 2 * whole.select([0]).torque_energy)


def test_merge_refuses_another_robot(robot):
    model, base = robot
    rigid = find_base_parameters(model)
    samples = recording(model, 300)
    with pytest.raises(IdentifiabilityError, match="cannot be merged"):
        accumulate(model, base, samples).merge(accumulate(model, rigid, samples))


def test_residual_energy_and_stack_follow_their_definition(robot):
    model, base = robot
    samples = recording(model, 500)
    information = accumulate(model, base, samples)
    beta = np.random.default_rng(2).normal(size=base.n_base)
    weights = np.arange(1.0, 8.0)
    errors = [stack @ np.append(-beta, 1.0) for stack in joint_stacks(model, base, samples)]
    energies = np.array([error @ error for error in errors])
    assert np.allclose(information.residual_energy(beta), energies, rtol=1e-11)
    total = information.stacked(weights) @ np.append(-beta, 1.0)
    assert total @ total == pytest.approx(weights**2 @ energies, rel=1e-11)
    alike = information.stacked() @ np.append(-beta, 1.0)
    assert alike @ alike == pytest.approx(energies.sum(), rel=1e-11)
    parts = [
        information.stacked(weights, b) @ np.append(-beta, 1.0) for b in range(information.n_blocks)
    ]
    assert sum(part @ part for part in parts) == pytest.approx(weights**2 @ energies, rel=1e-11)
    assert np.allclose(information.torque_sum.sum(axis=0), samples.tau.sum(axis=0))


def test_counts_and_times_are_those_of_the_recordings(robot):
    model, base = robot
    samples = recording(model, 600)
    later = replace(recording(model, 300, seed=2, source="field"), t=samples.t[:300] + 40.0)
    information = accumulate_stream(model, base, (samples, later), block_seconds=0.3)
    assert information.n_blocks == 30, "short blocks stay apart"
    assert information.sources == ("bench", "field")
    assert (information.n_samples, information.n_rows) == (900, 900 * 7)
    times = [(block.start, block.stop) for block in information.blocks]
    assert information.duration == pytest.approx(np.diff(times).sum())
    assert 8.5 < information.duration <= 9.0
    one = information.together()
    assert one.n_blocks == 1
    assert (one.blocks[0].start, one.blocks[0].stop) == (0.0, pytest.approx(42.99))
    assert one.n_samples == 900
    np.testing.assert_allclose(one.torque_sum[0], information.torque_sum.sum(axis=0))
    assert_same_gram(one.stacked(), information.stacked())
    still = replace(
        information,
        factors=(*information.factors[:-1], np.zeros_like(information.factors[-1])),
        torque_sum=information.torque_sum.copy(),
    )
    assert still.has_torque.tolist() == [True] * 6 + [False]
    assert still.n_rows == 900 * 6


def test_rows_are_mixed_where_each_has_a_part_of_all_joints(robot):
    model, base = robot
    assert not accumulate(model, base, recording(model, 100)).mixed, "a tree"
    rng = np.random.default_rng(5)
    every = np.arange(base.n_base)
    for n, mixed in ((2, True), (1, False)):
        shape = (1, base.n_base + 1, base.n_base + 1)
        information = SquareRootInformation(
            base,
            model.joint_names[:n],
            (every,) * n,
            tuple(np.triu(rng.normal(size=shape)) for _ in range(n)),
            np.zeros((1, n)),
            (TimeBlock("bench", 0.0, 1.0, 100),),
        )
        assert information.mixed is mixed


def test_merged_blocks_are_those_of_their_time(robot, monkeypatch):
    """Neighbours are merged; what is of another recording, or comes before, is not."""
    monkeypatch.setattr(square_root_information, "MOST_BLOCKS", 6)
    model, base = robot
    first, other = recording(model, 600), recording(model, 300, seed=2, source="field")
    again = recording(model, 300, seed=3)
    again = replace(again, t=again.t - 50.0)
    information = accumulate_stream(model, base, (first, other, again), block_seconds=0.5)
    assert 6 <= information.n_blocks <= 12
    assert max(block.stop - block.start for block in information.blocks) > 0.9
    assert information.n_samples == 1200
    for b, block in enumerate(information.blocks):
        whole = other if block.source == "field" else again if block.start < 0.0 else first
        own = np.flatnonzero((whole.t >= block.start - 1e-9) & (whole.t <= block.stop + 1e-9))
        assert len(own) == block.n_samples
        assert block.stop - block.start <= 1.2
        part = recording(
            model, len(own), **{x: getattr(whole, x)[own] for x in ("t", "q", "qd", "qdd", "tau")}
        )
        np.testing.assert_allclose(information.torque_sum[b], part.tau.sum(axis=0), atol=1e-9)
        only = information.select([b])
        assert_same_information(only, joint_stacks(model, base, part))
        np.testing.assert_allclose(only.torque_energy, (part.tau**2).sum(axis=0), rtol=1e-11)


def test_columns_beside_have_the_products_of_the_stacked_rows(robot):
    model, base = robot
    samples = recording(model, 900, segments=((0, 400), (420, 900)))
    further = FurtherColumns.tilts(model)
    information = accumulate_stream(model, base, (samples,), block_seconds=1.0, further=further)
    stacks = joint_stacks(model, base, samples)
    assert_same_information(information, stacks)
    taken = np.r_[0:400, 420:900]
    columns = np.stack(further.columns(samples.q[taken]), axis=-1)
    for k, (support, stack) in enumerate(zip(information.support, stacks, strict=True)):
        T = columns[:, k]
        rows = np.hstack([stack[:, [*support, -1]], T])
        np.testing.assert_allclose(further.products[k], rows.T @ T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("parallel", [False, True])
def test_rows_that_are_kept_are_those_of_the_stack_and_are_evaluated_once(
    robot, parallel, monkeypatch
):
    model, base = robot
    given = {"parallel": design_parallel_filter(10.0, 100.0)} if parallel else {}
    samples = recording(model, 1200, segments=((0, 500), (520, 1200)), slowest=(0.5,) * 7, **given)
    evaluated, evaluate = [], RegressorPlan.evaluate

    def counted(plan, q, *further, **named):
        evaluated.append(len(q))
        return evaluate(plan, q, *further, **named)

    monkeypatch.setattr(RegressorPlan, "evaluate", counted)
    kept, expected = KeptRows(), FurtherColumns.tilts(model)
    plain = accumulate_stream(model, base, [samples], block_seconds=2.0, further=expected)
    once = sum(evaluated)
    evaluated.clear()
    for seconds in (2.0, 3.0):
        tilts = FurtherColumns.tilts(model)
        found = accumulate_stream(
            model, base, [samples], block_seconds=seconds, further=tilts, kept=kept
        )
        for a, b in zip(found.joint_factors, plain.joint_factors, strict=True):
            assert_same_gram(a, b)
        for a, b in zip(tilts.products, expected.products, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-8)
    assert 0 < sum(evaluated) <= once
    # Another torque or another robot is another question.
    other = replace(samples, tau=2.0 * samples.tau)
    found = accumulate_stream(model, base, [other], kept=kept)
    assert found.torque_energy == pytest.approx(4.0 * plain.torque_energy)


def test_rows_that_would_take_much_memory_are_not_kept(robot, monkeypatch):
    model, base = robot
    samples = recording(model, 400)
    plan = RegressorPlan.of(model, base.drive, base.columns)
    assert KeptRows().find(plan, samples) is not None
    monkeypatch.setattr(rows_module, "ROWS", replace(rows_module.ROWS, most_held=1e4))
    assert KeptRows().find(plan, samples) is None


def test_rows_of_an_estimator_are_summed_and_read_only(robot):
    model, base = robot
    samples = recording(model, 400)
    rows = Rows(model, base, [samples], 1.0)
    information = reduce_rows(base, model.joint_names, rows.support, rows)
    assert_same_information(information, joint_stacks(model, base, samples))
    np.testing.assert_allclose(information.torque_sum.sum(axis=0), samples.tau.sum(axis=0))
    for array in (information.torque_sum, *information.factors):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


@pytest.mark.study
def test_a_long_stream_keeps_a_bounded_number_of_blocks_and_all_the_information(robot):
    model, base = robot
    pieces = [recording(model, 250, seed=s) for s in range(40)]
    moved = [replace(piece, t=piece.t + 2.5 * s) for s, piece in enumerate(pieces)]
    information = accumulate_stream(model, base, iter(moved), block_seconds=0.02)
    assert MOST_BLOCKS // 2 <= information.n_blocks <= 2 * MOST_BLOCKS
    assert information.n_samples == 40 * 250
    lengths = [block.stop - block.start for block in information.blocks]
    assert max(lengths) < 4 * np.median(lengths)
    energy = sum((piece.tau**2).sum(axis=0) for piece in pieces)
    assert np.allclose(information.torque_energy, energy, rtol=1e-11)


def test_values_that_are_not_numbers_are_refused(robot):
    model, base = robot
    samples = recording(model, 400)
    tau = samples.tau.copy()
    tau[17, 3] = np.nan
    with pytest.raises(IdentifiabilityError, match="NaN"):
        accumulate(model, base, replace(samples, tau=tau, tau_raw=np.empty((0, 0))))


def test_triangular_factor_has_a_non_negative_diagonal_also_of_few_or_dependent_rows():
    rng = np.random.default_rng(0)
    for rows in (
        rng.normal(size=(3, 6)),
        np.outer(rng.normal(size=9), rng.normal(size=6)),
        np.zeros((4, 6)),
    ):
        factor = triangular_factor(rows)
        assert factor.shape == (6, 6)
        assert np.all(np.diag(factor) >= 0)
        assert np.allclose(factor.T @ factor, rows.T @ rows, rtol=0, atol=1e-13)


def test_samples_of_other_joints_are_refused(robot):
    model, base = robot
    with pytest.raises(IdentifiabilityError, match="matches joints by name"):
        accumulate(model, base, recording(model, 100, joint_names=tuple("abcdefg")))


def test_a_recording_read_in_pieces_gives_what_the_whole_gives(robot):
    model, base = robot
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 60.0, 0.005)
    frequency, phase = rng.uniform(0.1, 0.5, (3, 1, 7)), rng.uniform(0, 6, (3, 1, 7))
    q = np.sum(0.3 * np.sin(2 * np.pi * frequency * t[:, None] + phase), axis=0)
    whole = Recording(t, q, rng.normal(size=q.shape), joint_names=model.joint_names, source="bench")
    chain = SignalChain(cutoff=5.0)
    pieces = (whole.taken(slice(start, start + 2500)) for start in range(0, t.size, 2500))
    streamed = accumulate_stream(model, base, stream_samples(pieces, chain))
    at_once = accumulate(model, base, prepare_samples(whole, chain))
    assert streamed.n_samples == at_once.n_samples
    for a, b in zip(streamed.joint_factors, at_once.joint_factors, strict=True):
        assert np.allclose(a.T @ a, b.T @ b, rtol=0, atol=1e-8 * np.abs(a.T @ a).max())


def test_expected_scores_are_taken_from_the_torque(robot):
    model, base = robot
    samples = recording(model)
    information = accumulate(model, base, samples)
    means, rng = [], np.random.default_rng(2)
    for support, factor in zip(information.support, information.joint_factors, strict=True):
        R = factor[:-1, :-1]
        means.append(R.T @ R @ rng.normal(size=support.size) / information.n_samples)
    names = tuple(tuple(base.names[j] for j in support) for support in information.support)
    less = MeanScores(names, tuple(means)).torques(information)
    changed = information.less(less)
    for k, mean in enumerate(means):
        before, after = (each.joint_factors[k] for each in (information, changed))
        score = (before.T @ before - after.T @ after)[:-1, -1]
        np.testing.assert_allclose(score, information.n_samples * mean, rtol=1e-6, atol=1e-6)
    rows = EstimationData(model, information, [samples], less=less).rows
    again = reduce_rows(base, model.joint_names, rows.support, rows)
    for one, other in zip(changed.joint_factors, again.joint_factors, strict=True):
        np.testing.assert_allclose(one.T @ one, other.T @ other, rtol=1e-9, atol=1e-6)


def test_short_blocks_keep_their_rows(robot) -> None:
    model, base = robot
    samples = recording(model)
    information = accumulate(model, base, samples, block_seconds=0.1)
    longest = max(block.n_samples for block in information.blocks)
    for support, factors in zip(information.support, information.factors, strict=True):
        assert factors.shape[1] == min(longest, len(support) + 1)
    assert_same_information(information, joint_stacks(model, base, samples))
    weights = np.linspace(0.5, 2.0, model.n_joints)
    assert_same_gram(information.rows_of_block(3, weights), information.stacked(weights, 3))


def test_sums_over_joints_are_the_squares_of_their_factor(robot) -> None:
    model, base = robot
    information = accumulate(model, base, recording(model))
    weights = np.linspace(0.5, 2.0, model.n_joints)
    factor = information.stacked(weights)
    total = factor.T @ factor
    assert np.allclose(information.summed(weights), total, rtol=0, atol=1e-12 * total.max())
    root = np.linalg.inv(factor[:-1, :-1])
    leverages = [
        weight**2 * np.sum((own[:, :-1] @ root[support]) ** 2)
        for own, support, weight in zip(
            information.joint_factors, information.support, weights, strict=True
        )
    ]
    assert information.spent(weights, root @ root.T) == pytest.approx(leverages, rel=1e-9)


@pytest.mark.parametrize("parallel", [None, design_parallel_filter(8.0, 100.0, 3)])
def test_a_filtered_sample_touches_the_samples_of_its_window(robot, parallel) -> None:
    model, _ = robot
    samples = recording(model, parallel=parallel, segments=((0, 700), (720, 1500)))
    step, width = (parallel.decimation, parallel.taps.size) if parallel else (1, 1)
    some = np.random.default_rng(4).random(samples.n_samples) < 0.01
    for block in divide_into_blocks(model, [samples], 2.0):
        begin = block.start + step * np.arange(block.first, block.last)
        expected = [bool(some[k : k + width].any()) for k in begin]
        assert block.touches(some).tolist() == expected
