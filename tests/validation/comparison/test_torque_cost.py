from dataclasses import replace

import numpy as np
from virtual_causes import identified, recorded

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.excitation import FourierMotion
from asbuilt.experiment import SensorNoise, SignalChain, VirtualRobot, hold_out, prepare_samples
from asbuilt.identification import identify_samples
from asbuilt.identification.information.cause_data import gather_cause_data
from asbuilt.validation import CadTolerance, compare, validate_samples
from asbuilt.validation.comparison.torque_change import evaluate_torque_cost
from asbuilt.writers.figures.comparison_figures import draw_differences

ARM = "kuka-iiwa7-r800"


def test_costs_are_those_of_the_whole_observation_matrix() -> None:
    result = identified(ARM, "pf")
    model = load_robot(ARM)
    _, held = hold_out(prepare_samples(recorded(ARM, "pf"), SignalChain()), "blocks:2s:3")
    W = observation_matrix(
        model, held.q, held.qd, held.qdd, drive=result.base.drive, columns=result.base.columns
    )
    W = held.filtered(W.reshape(len(held.t), 7, -1))
    difference = result.estimates - np.nan_to_num(result.cad_values)
    cost = evaluate_torque_cost(result.cause_data, result.base, difference)
    contributions = W * difference
    np.testing.assert_allclose(
        cost.torque, np.sqrt(np.mean(contributions**2, axis=0)).T, rtol=1e-6, atol=1e-9
    )
    rows = W.reshape(-1, result.n_base)
    for j in (0, 17, 30, result.n_base - 1):
        others = np.delete(rows, j, axis=1)
        alone = rows[:, j] - others @ np.linalg.lstsq(others, rows[:, j], rcond=None)[0]
        np.testing.assert_allclose(
            cost.own[j],
            np.linalg.norm(alone * difference[j]) / np.sqrt(len(W)),
            rtol=1e-3,
            atol=1e-9,
        )
    assert np.all(cost.own <= cost.total * (1 + 1e-9))
    unit = rows / np.linalg.norm(rows, axis=0)
    for j in range(result.n_base):
        likeness = np.abs(unit.T @ unit[:, j])
        likeness[j] = 0.0
        best = int(np.argmax(likeness))
        assert cost.partners[j][:1] == ((best,) if likeness[best] ** 2 >= 0.25 else ())
        for two in (cost.partners[j],) if len(cost.partners[j]) == 2 else ():
            one_left, both_left = (
                unit[:, j]
                - unit[:, places] @ np.linalg.lstsq(unit[:, places], unit[:, j], rcond=None)[0]
                for places in (two[:1], two)
            )
            assert both_left @ both_left <= 0.75 * (one_left @ one_left)


def test_torque_that_others_could_make_is_shared_and_does_not_matter_by_itself() -> None:
    """Slow motion about one pose hardly tells a first moment from an offset.

    Its difference costs torque, none of it its own.
    """
    model = load_robot(ARM)
    rng = np.random.default_rng(0)
    motion = FourierMotion(
        np.vstack([np.linspace(0.3, 0.9, 7), 0.05 * rng.normal(size=(6, 7))]),
        period=10.0,
        periods=4,
    )
    machine = (
        VirtualRobot.ideal(model)
        .with_drive(DriveSet.parse("viscous,coulomb,offset"), np.tile([1.0, 2.0, 3.0], 7))
        .with_noise(SensorNoise(torque_noise=0.05))
    )
    samples = prepare_samples(machine.record(motion, rate=100.0, rng=1).recording, SignalChain())
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    result = identify_samples(model, samples, base=base)
    comparison = compare(replace(result, cause_data=gather_cause_data(model, base, [samples])))
    left = comparison.torque[0][1].rms
    shared = [each for each in comparison.parameters if each.shared_with]
    assert shared
    for each in shared:
        assert not each.matters
        assert np.any(np.array(each.torque) >= 0.4 * left)
        assert f"shared with {', '.join(each.shared_with)}" in comparison.parameter_table().as_csv()


def test_evidence_judges_as_validation_does() -> None:
    result = identified(ARM, "pf")
    _, held = hold_out(prepare_samples(recorded(ARM, "pf"), SignalChain()), "blocks:2s:3")
    validation = validate_samples(result, held)
    np.testing.assert_allclose(
        result.cause_data.error_of(result.base.names, result.estimates),
        validation.metrics_as_built.rms,
        rtol=1e-9,
    )
    design = np.nan_to_num(result.cad_values)
    np.testing.assert_allclose(
        result.cause_data.error_of(result.base.names, design), validation.metrics_cad.rms, rtol=1e-9
    )


def test_what_matters_comes_first_and_is_not_what_differs() -> None:
    comparison = compare(identified(ARM, "p"))
    totals = [parameter.torque_total or 0.0 for parameter in comparison.ranked]
    assert totals == sorted(totals, reverse=True)
    assert comparison.ranked[0].matters
    assert comparison.ranked[0].verdict == "differs"
    assert 0 < comparison.n_mattering < comparison.n_compared
    text = comparison.as_text(full=True)
    assert "matters" in text
    assert "degrees of freedom, p" in text
    figure = draw_differences(comparison)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert len(labels) == sum(total >= 0.02 * totals[0] for total in totals)
    assert "mz2  (first moment along z, links 2 to 7)" in labels


def test_without_a_difference_about_as_many_differ_as_the_rate_allows() -> None:
    comparison = compare(identified(ARM, ""))
    assert comparison.n_differing <= 4
    assert comparison.n_mattering == 0
    assert comparison.chi_square.probability > 1e-4


def test_tolerances_of_cad_cover_links_that_are_off_by_as_much() -> None:
    wrong = identified(ARM, "l")
    assert compare(wrong).chi_square.probability < 1e-6
    covered = compare(wrong, tolerance=CadTolerance(0.3, 0.3, 0.5))
    assert covered.chi_square_tolerance.probability > 0.01
    assert "CAD is within its tolerances" in covered.as_text()
    assert covered.tolerance_needed is None
    assert covered.beyond_tolerance == ()
    claimed = CadTolerance(0.01, 0.01, 0.01)
    narrow = compare(wrong, tolerance=claimed)
    assert 1.0 < narrow.tolerance_needed < 30.0
    assert set(narrow.beyond_tolerance) <= set(wrong.base.names)
    assert "times as wide" in narrow.as_text()
    assert (
        "CAD is within its tolerances"
        in compare(wrong, tolerance=claimed.scaled(1.01 * narrow.tolerance_needed)).as_text()
    )
    assert (
        "CAD is beyond its tolerances"
        in compare(wrong, tolerance=claimed.scaled(0.9 * narrow.tolerance_needed)).as_text()
    )
