"""What is chosen, and that the summary says why."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from three_links import DRIVE, arm, recording, truth

from asbuilt.description import DHRow, robot_from_dh
from asbuilt.dynamics import find_base_parameters
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification import EstimationData, Rows, estimate_wls, identify_samples, summarise
from asbuilt.identification.estimators.auto import estimate_auto
from asbuilt.identification.information import rows


def chosen(robot, samples):
    model, base, _ = robot
    result = identify_samples(model, samples, drive=DRIVE, base=base, method="auto")
    assert result.notes[0].startswith("Chosen automatically: ")
    assert result.notes[0] in " ".join(summarise(result).as_text(full=True).split())
    return result


def codes(result):
    return {warning.code for warning in result.findings}


def test_collisions_call_for_huber(robot):
    samples = recording(*robot, noise=0.02, seconds=60.0, seed=2)
    tau = samples.tau.copy()
    tau[1000:1040] += [30.0, 20.0, 10.0]
    spoilt = replace(samples, tau=tau, tau_raw=np.empty((0, 0)))
    result = chosen(robot, spoilt)
    assert "huber: " in result.notes[0]
    assert "robust variance" in result.notes[0]
    plain = identify_samples(robot[0], spoilt, drive=DRIVE, base=robot[1], method="wls")
    error, of_plain = (
        np.linalg.norm((each.estimates - robot[2]) / plain.std_errors) for each in (result, plain)
    )
    assert error < 0.5 * of_plain


def test_impossible_bodies_give_way_to_real_ones_that_predict_as_well(robot):
    result = chosen(robot, recording(*robot, noise=4.0, seconds=30.0, seed=6))
    assert result.method in ("consistent", "entropic")
    assert result.physically_consistent
    assert "groups of time blocks" in result.notes[0]
    assert "groups of motion held out" in result.notes[1]
    assert "consistent_fit_costly" not in codes(result)


def test_values_that_no_bodies_have_stay_where_these_predict_worse(robot):
    model, base, beta = robot
    impossible = beta.copy()
    impossible[base.names.index("Ixz3")] += 0.5
    samples = recording(model, base, impossible, noise=0.1, seconds=60.0, seed=2)
    result = chosen(robot, samples)
    assert result.method == "wls"
    assert not result.physically_consistent
    assert "consistent_fit_rejected" in codes(result)
    real = identify_samples(model, samples, drive=DRIVE, base=base, method="consistent")
    assert real.train.rms.max() > 2 * result.train.rms.max()


def test_too_few_blocks_take_the_usual_weight_and_cost_is_said(robot):
    model, base, beta = robot
    impossible = beta.copy()
    impossible[base.names.index("Ixz3")] += 0.5
    result = chosen(robot, recording(model, base, impossible, noise=0.1, seconds=2.0, seed=2))
    assert result.method == "entropic"
    assert "too few" in result.notes[0]
    (costly,) = (each for each in result.findings if each.code == "consistent_fit_costly")
    assert "% of its torque (else" in costly.message
    assert re.search("no passive drive or body has: .*Ixz3", costly.message)


def test_joint_that_stands_is_consistent_and_said(robot):
    result = chosen(robot, recording(*robot, noise=0.02, seconds=60.0, seed=2, still=(2,)))
    assert result.physically_consistent
    assert result.undetermined


def test_candidates_that_do_not_converge_are_left_out_and_named(robot, monkeypatch):
    def fails(*_, **__):
        raise IdentifiabilityError("no closest bodies after 300 steps")

    monkeypatch.setattr("asbuilt.identification.bodies.entropic_fit.EntropicProblem.fit", fails)
    result = chosen(robot, recording(*robot, noise=4.0, seconds=30.0, seed=6))
    assert result.method == "consistent"
    assert any("Left out" in note and "entropic (weight" in note for note in result.notes)
    monkeypatch.setattr("asbuilt.identification.estimators.auto.fit_consistent", fails)
    result = chosen(robot, recording(*robot, noise=4.0, seconds=30.0, seed=6))
    assert result.method == "wls"
    assert "no closest bodies" in result.notes[0]


def test_without_masses_cad_has_no_weight():
    rows = [DHRow(a=0.3, alpha=alpha) for alpha in (np.pi / 2, 0.0, -np.pi / 2)]
    bare = robot_from_dh(rows, name="three links", gravity=[0.0, 0.0, -9.81])
    base = find_base_parameters(bare, DRIVE)
    beta = truth(base, arm())
    result = chosen((bare, base, beta), recording(bare, base, beta, noise=0.02, seconds=30.0))
    assert result.method in ("consistent", "wls")


def test_undetermined_directions_that_are_refused_leave_plain_values(robot):
    model, base, _ = robot
    samples = recording(*robot, noise=4.0, seconds=30.0, seed=6)
    result = identify_samples(
        model, samples, drive=DRIVE, base=base, method="auto", undetermined="refuse"
    )
    assert result.method == "wls"
    assert "are refused" in result.notes[0]


@pytest.mark.parametrize("make", ["kuka-iiwa7-r800", "ur10e", "puma-560"])
@pytest.mark.study
def test_nearness_to_cad_follows_how_right_cad_is(trial, make):
    """Weights fall as CAD gets worse, and other motions are predicted no worse than plainly."""
    drive = "viscous,coulomb,offset"
    prior = trial(make, drive, duration=1.0).prior
    right = prior.parameters.copy()
    right[10 * prior.n_links :] = 0.3
    beliefs = []
    for spread in (0.0, 0.05, 0.6):
        case = trial(
            make,
            drive,
            noise=0.05,
            seed=4,
            duration=60.0,
            spread=spread,
            chi=None if spread else right,
        )
        other = trial(make, drive, noise=0.0, seed=5, duration=20.0, chi=case.chi)
        data = EstimationData(case.model, case.information, [case.samples])
        auto, plain = estimate_auto(data), estimate_wls(data)
        error, of_plain = (
            float(np.sum(other.information.residual_energy(each.beta))) for each in (auto, plain)
        )
        assert error <= 0.5 * of_plain
        beliefs.append(getattr(auto, "prior_weight", 0.0))
    assert min(beliefs[:2]) > 2.0 * beliefs[2]
    assert beliefs[0] > 10.0


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
    monkeypatch.setattr(rows, "ROWS", replace(rows.ROWS, most_held=1.0))
    made = Rows(model, base, [samples])
    for again in (list(made), list(made)):
        for one, other in zip(first, again, strict=True):
            assert one.time == other.time
            for a, b in zip(one.rows, other.rows, strict=True):
                np.testing.assert_array_equal(a, b)
