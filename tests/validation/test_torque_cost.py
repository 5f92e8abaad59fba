import numpy as np
from virtual_causes import identified, recorded

from asbuilt.description.load import load_robot
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.hold_out import hold_out
from asbuilt.experiment.signal_chain import SignalChain, prepare_samples
from asbuilt.validation.comparison import compare
from asbuilt.validation.prediction import validate
from asbuilt.validation.significance import CadTolerance
from asbuilt.validation.torque_cost import torque_cost
from asbuilt.writers.cause_figures import difference_figure

ARM = "kuka-iiwa7-r800"


def test_costs_are_those_of_the_whole_observation_matrix() -> None:
    result = identified(ARM, "pf")
    model = load_robot(ARM)
    _, held = hold_out(prepare_samples(recorded(ARM, "pf"), SignalChain()), "blocks:2s:3")
    W = observation_matrix(model, held.q, held.qd, held.qdd, drive=result.base.drive, columns=result.base.columns)
    W = held.filtered(W.reshape(len(held.t), 7, -1))
    difference = result.estimates - np.nan_to_num(result.cad_values)
    cost = torque_cost(result.evidence, result.base, difference)
    contributions = W * difference
    np.testing.assert_allclose(cost.torque, np.sqrt(np.mean(contributions**2, axis=0)).T, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(cost.together, np.sqrt(np.mean((W @ difference) ** 2, axis=0)), rtol=1e-6)
    rows = W.reshape(-1, result.n_base)
    for j in (0, 17, 30, result.n_base - 1):
        others = np.delete(rows, j, axis=1)
        alone = rows[:, j] - others @ np.linalg.lstsq(others, rows[:, j], rcond=None)[0]
        np.testing.assert_allclose(cost.own[j], np.linalg.norm(alone * difference[j]) / np.sqrt(len(W)), rtol=1e-3, atol=1e-9)
    assert np.all(cost.own <= cost.total * (1 + 1e-9))


def test_evidence_judges_as_validation_does() -> None:
    result = identified(ARM, "pf")
    _, held = hold_out(prepare_samples(recorded(ARM, "pf"), SignalChain()), "blocks:2s:3")
    validation = validate(result, held)
    np.testing.assert_allclose(result.evidence.error_of(result.base.names, result.estimates), validation.metrics_as_built.rms, rtol=1e-9)
    design = np.nan_to_num(result.cad_values)
    np.testing.assert_allclose(result.evidence.error_of(result.base.names, design), validation.metrics_cad.rms, rtol=1e-9)


def test_what_matters_comes_first_and_is_not_what_differs() -> None:
    comparison = compare(identified(ARM, "p"))
    totals = [parameter.torque_total or 0.0 for parameter in comparison.ranked]
    assert totals == sorted(totals, reverse=True)
    assert comparison.ranked[0].matters
    assert comparison.ranked[0].verdict == "differs"
    assert 0 < comparison.n_mattering < comparison.n_compared
    text = comparison.as_text()
    assert "matters" in text
    assert "chi-square" in text
    figure = difference_figure(comparison)
    assert len(figure.axes[0].get_yticklabels()) == 24


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
