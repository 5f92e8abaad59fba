"""What is chosen, and that the summary says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import ttest_rel
from three_links import DRIVE, recording

from asbuilt.identification.estimators.auto import _better
from asbuilt.identification.identify import identify_samples
from asbuilt.identification.information.rows import Rows
from asbuilt.identification.result.summary import summarise


def chosen(robot, samples):
    model, base, _ = robot
    result = identify_samples(model, samples, drive=DRIVE, base=base, method="auto")
    assert result.notes[0].startswith("Chosen automatically: ")
    assert result.notes[0] in " ".join(summarise(result).as_text(full=True).split())
    return result


def codes(result):
    return {warning.code for warning in result.findings}


def test_good_recording_of_possible_bodies_is_left_to_weighted_least_squares(robot):
    result = chosen(robot, recording(*robot, noise=0.02, seconds=60.0, seed=2))
    assert result.method == "wls"
    assert result.physically_consistent


def test_collisions_call_for_huber(robot):
    samples = recording(*robot, noise=0.02, seconds=60.0, seed=2)
    tau = samples.tau.copy()
    tau[1000:1040] += [30.0, 20.0, 10.0]
    result = chosen(robot, replace(samples, tau=tau, tau_raw=np.empty((0, 0))))
    assert result.method == "huber"
    assert "robust variance" in result.notes[0]


def test_impossible_bodies_give_way_to_real_ones_that_predict_as_well(robot):
    result = chosen(robot, recording(*robot, noise=4.0, seconds=12.0, seed=6))
    assert result.method in ("consistent", "entropic")
    assert result.physically_consistent
    assert "groups of held-out time blocks (squared error of" in result.notes[0]
    assert "consistent_fit_costly" not in codes(result)


def test_values_that_no_bodies_have_stay_where_these_predict_worse(robot):
    model, base, beta = robot
    impossible = beta.copy()
    impossible[base.names.index("Ixz3")] += 0.5
    samples = recording(model, base, impossible, noise=0.1, seconds=60.0, seed=2)
    result = chosen(robot, samples)
    assert result.method == "wls"
    assert not result.physically_consistent
    assert "wls kept" in result.notes[0]
    assert "consistent_fit_rejected" in codes(result)
    real = identify_samples(model, samples, drive=DRIVE, base=base, method="consistent")
    assert real.train.rms.max() > 2 * result.train.rms.max()


def test_strain_of_real_bodies_is_told(robot):
    model, base, beta = robot
    impossible = beta.copy()
    impossible[base.names.index("Ixz3")] += 0.5
    result = chosen(robot, recording(model, base, impossible, noise=0.1, seconds=2.0, seed=2))
    assert result.method == "consistent"
    assert "too few" in result.notes[0]
    assert "consistent_fit_costly" in codes(result)


def test_better_is_more_than_one_standard_error_of_paired_errors():
    rng = np.random.default_rng(0)
    verdicts = []
    for _ in range(200):
        errors, others = rng.normal(size=8), rng.normal(0.3, size=8)
        verdicts.append(_better(errors, others))
        assert verdicts[-1] == (ttest_rel(errors, others).statistic < -1.0)
    assert 0.1 < np.mean(verdicts) < 0.9


def test_joint_that_stands_leans_on_cad(robot):
    result = chosen(robot, recording(*robot, noise=0.02, seconds=60.0, seed=2, still=(2,)))
    assert "not excited" in result.notes[0]
    assert result.undetermined


def test_every_so_manyth_block_is_looked_through(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, seconds=60.0)
    whole, third = (list(Rows(model, base, [samples], 2.0, every)) for every in (1, 3))
    assert [block.time for block in third] == [block.time for block in whole][::3]


def test_rows_are_the_same_whether_they_are_held_or_made_again(robot, monkeypatch):
    model, base, beta = robot
    samples = recording(model, base, beta, seconds=20.0)
    held = Rows(model, base, [samples])
    first = list(held)
    assert next(iter(held)) is first[0]
    monkeypatch.setattr("asbuilt.identification.information.rows.MOST_HELD", 1.0)
    made = Rows(model, base, [samples])
    for again in (list(made), list(made)):
        for one, other in zip(first, again, strict=True):
            assert one.time == other.time
            for a, b in zip(one.rows, other.rows, strict=True):
                np.testing.assert_array_equal(a, b)
