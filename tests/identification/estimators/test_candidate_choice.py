"""Groups of different motion, leverage by dense matrices, and the one-standard-error rule."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ttest_rel
from three_links import DRIVE, recording

from asbuilt.dynamics import observation_matrix
from asbuilt.identification import accumulate_stream, divide_into_folds
from asbuilt.identification.estimators.held_out_choice import (
    Candidate,
    choose_candidate,
    group_different_motions,
)
from asbuilt.identification.information.random_states import (
    build_random_motion_rows,
    measure_recorded_rates,
)
from asbuilt.statistics import exceeds


def test_blocks_of_two_motions_are_told_apart(robot):
    model, base, beta = robot
    parts = [
        recording(
            model, base, beta, seconds=40.0, seed=seed, still=still, source=source, parallel=False
        )
        for seed, still, source in ((1, (0,), "a"), (2, (2,), "b"), (1, (0,), "c"))
    ]
    information = accumulate_stream(model, base, parts, block_seconds=5.0)
    groups = group_different_motions(information, np.ones(3), most=2)
    sources = [{information.blocks[b].source for b in group} for group in groups]
    assert sorted(map(sorted, sources)) == [["a", "c"], ["b"]]


def choice_of(robot, betas, variance=0.0, weights=(10.0, 0.0), certain=(True, True)):
    """Choose among estimates that are the same for each group (p,), or not (n_folds, p)."""
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.2, seconds=60.0, seed=3, parallel=False)
    information = accumulate_stream(model, base, [samples], block_seconds=5.0)
    parts = list(divide_into_folds(information, group_different_motions(information, np.ones(3))))
    motion = build_random_motion_rows(model, base, measure_recorded_rates([samples]))
    prior = np.diag(np.linspace(1.0, 2.0, base.n_base))
    candidates = [
        Candidate(f"c{k}", weight, np.broadcast_to(values, (len(parts), base.n_base)), sure)
        for k, (values, weight, sure) in enumerate(zip(betas, weights, certain, strict=True))
    ]
    found = choose_candidate(candidates, parts, information, np.ones(3), prior, motion, variance)
    return found, samples, motion, prior, parts


def test_errors_and_leverage_are_those_of_dense_matrices(robot):
    model, base, beta = robot
    found, samples, motion, prior, parts = choice_of(robot, [beta, 0.9 * beta], variance=2.0)
    W = observation_matrix(
        model, samples.q, samples.qd, samples.qdd, drive=DRIVE, columns=base.columns
    ).reshape(-1, 3, base.n_base)
    places = {round(float(t), 6): k for k, t in enumerate(samples.t)}
    beyond = []
    for weight in (10.0, 0.0):
        held_leverage = []
        for fold, (_, held) in enumerate(parts):
            inside = np.zeros(len(W), bool)
            for block in held.blocks:
                first = places[round(block.start, 6)]
                inside[first : first + block.n_samples] = True
            rows, rest = W[inside].reshape(-1, base.n_base), W[~inside].reshape(-1, base.n_base)
            if weight:
                error = samples.tau[inside].ravel() - rows @ beta
                np.testing.assert_allclose(found.errors[0, fold], np.mean(error**2), rtol=1e-8)
            C = np.linalg.inv(rest.T @ rest + weight * prior)
            held_leverage.append(np.mean(np.einsum("ij,jk,ik->i", rows, C, rows)))
        whole = W.reshape(-1, base.n_base)
        C = np.linalg.inv(whole.T @ whole + weight * prior)
        at_random = np.mean(np.einsum("ij,jk,ik->i", motion, C, motion))
        beyond.append(2.0 * max(at_random - np.mean(held_leverage), 0.0))
    np.testing.assert_allclose(found.extrapolation, beyond, rtol=1e-6, atol=1e-9)


def test_ties_go_to_the_candidate_closest_to_cad(robot):
    beta = robot[2]
    assert choice_of(robot, [1.0001 * beta, beta])[0].chosen == 0
    assert choice_of(robot, [1.5 * beta, beta])[0].chosen == 1


@pytest.mark.study
def test_inconsistent_values_must_predict_better_beyond_chance(robot):
    beta = robot[2]
    sure = choice_of(robot, [1.5 * beta, beta], certain=(True, False))[0]
    assert sure.chosen == 1
    found, *_, parts = choice_of(robot, [beta, beta], certain=(True, False))
    assert found.chosen == 0
    rng, p_values = np.random.default_rng(0), []
    for _ in range(40):
        drawn = beta * (1.0 + 0.1 * rng.normal(size=(2, len(parts), len(beta))))
        found = choice_of(robot, drawn, certain=(True, False))[0]
        totals = found.errors + found.extrapolation[:, None]
        test = ttest_rel(totals[0], totals[1], alternative="greater")
        p_values.append(float(test.pvalue))
        assert (found.chosen == 1) is (p_values[-1] < 0.05)
    assert 0 < np.sum(np.array(p_values) < 0.05) < np.sum(np.array(p_values) < 0.16)


def test_extrapolation_decides_where_folds_cannot(robot):
    beta = robot[2]
    assert choice_of(robot, [1.5 * beta, beta], variance=1e9)[0].chosen == 0


def test_beyond_a_standard_error_of_paired_differences():
    rng = np.random.default_rng(0)
    verdicts = []
    for _ in range(200):
        errors, others = rng.normal(0.3, size=8), rng.normal(size=8)
        verdicts.append(exceeds(errors - others, 1.0))
        assert verdicts[-1] == (ttest_rel(errors, others).statistic > 1.0)
    assert 0.1 < np.mean(verdicts) < 0.9
