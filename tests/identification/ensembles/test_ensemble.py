from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student
from tests.identification.ensembles.example_results import servo_result, two_link_result

from asbuilt.description import bundled_robot
from asbuilt.description.inertia import pseudo_inertias
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.errors import UsageError
from asbuilt.executor import open_workers
from asbuilt.identification import (
    Ensemble,
    IdentificationResult,
    build_cad_prior,
    draw_ensemble,
    widening,
)
from asbuilt.identification.ensembles.ensemble import AT_ONCE, FAITHFUL, make_draws_consistent
from asbuilt.identification.uncertainty.block_scatter import BlockScatter, mean_degrees

NORMAL_95 = 1.644854


@pytest.fixture(scope="module")
def result() -> IdentificationResult:
    return two_link_result()


@pytest.fixture(scope="module")
def ensemble(result: IdentificationResult) -> Ensemble:
    return draw_ensemble(result, 1500, rng=3)


@pytest.mark.study
def test_base_parameters_have_the_quantiles_of_their_normal_distribution(
    result: IdentificationResult, ensemble: Ensemble
) -> None:
    beta = ensemble.parameters @ result.base.regrouping.T
    low, high = np.quantile(beta, [0.05, 0.95], axis=0)
    std = result.std_errors
    np.testing.assert_allclose((low - result.estimates) / std, -NORMAL_95, atol=0.2)
    np.testing.assert_allclose((high - result.estimates) / std, NORMAL_95, atol=0.2)


def test_correlations_are_those_of_the_covariance(
    result: IdentificationResult, ensemble: Ensemble
) -> None:
    beta = ensemble.parameters @ result.base.regrouping.T
    size = np.sqrt(np.diag(result.covariance))
    expected = result.covariance / np.outer(size, size)
    assert np.abs(expected - np.eye(len(size))).max() > 0.5
    np.testing.assert_allclose(np.corrcoef(beta.T), expected, atol=0.12)


def test_every_robot_is_possible_and_next_to_its_draw(
    result: IdentificationResult, ensemble: Ensemble
) -> None:
    links = ensemble.parameters[:, : 10 * result.model.n_joints].reshape(-1, 10)
    assert np.linalg.eigvalsh(pseudo_inertias(links)).min() > 0.0
    names = np.array(ensemble.names)
    friction = [k for k, name in enumerate(names) if name[:2] in ("Fv", "Fc")]
    assert ensemble.table[:, friction].min() > 0.0
    assert np.quantile(ensemble.chi_square, 0.95) < FAITHFUL


def test_a_friction_that_may_be_zero_is_never_negative(result: IdentificationResult) -> None:
    base, prior = result.base, build_cad_prior(result.model, result.base.drive)
    place = base.names.index("Fv1")
    drawn = np.tile(result.estimates, (2, 1))
    drawn[0, place] = -3.0 * abs(drawn[0, place])
    root = np.diag(1.0 / result.std_errors)
    chi, chi_square = make_draws_consistent(prior, base, drawn, root)
    moved = (chi @ base.regrouping.T)[0, place]
    assert 0.0 <= moved < 0.1 * result.estimates[place]
    assert chi_square[0] > 1.0 > FAITHFUL > chi_square[1]


def test_the_same_seed_gives_the_same_robots(result: IdentificationResult) -> None:
    one, two, other = (draw_ensemble(result, 4, rng=seed).table for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert np.abs(one - other).max() > 0.0


def test_the_friction_of_a_joint_follows_the_stiffness_of_its_servo() -> None:
    result = servo_result(shared=False, relative=0.2)
    ensemble = draw_ensemble(result, 400, rng=0)
    place = [ensemble.names.index(name) for name in ("Fc1", "Fc2")]
    found = np.corrcoef(ensemble.table[:, place].T, ensemble.gains.table[:, :2].T)[:2, 2:]
    np.testing.assert_allclose(found, np.eye(2), atol=0.15)


def test_a_shared_stiffness_scales_the_whole_robot() -> None:
    result = servo_result(shared=True, relative=0.2)
    table = draw_ensemble(result, 400, rng=0)
    assert result.servo is not None
    factors = table.gains.table[:, :2] / np.array(result.servo.kp)
    np.testing.assert_allclose(factors[:, 0], factors[:, 1], rtol=1e-12)
    assert np.std(np.log(factors[:, 0])) == pytest.approx(0.2, rel=0.15)
    places = [result.base.names.index(f"Fc{k}") for k in (1, 2)]
    friction = (table.parameters @ result.base.regrouping.T)[:, places]
    for column in friction.T:
        assert np.corrcoef(column, factors[:, 0])[0, 1] > 0.98
    assert np.std(table.gains.table[:, -1]) == pytest.approx(5e-4, rel=0.2)
    assert table.gains.law(7).kp == tuple(table.gains.table[7, :2])  # type: ignore[union-attr]


def test_no_robots_are_refused(result: IdentificationResult) -> None:
    with pytest.raises(UsageError, match="1 to 100000 robots, got 0"):
        draw_ensemble(result, 0)


@pytest.mark.study
def test_few_time_blocks_give_students_distribution(result: IdentificationResult) -> None:
    """Quantiles of the draws against those of Student's distribution, by SciPy."""
    p, freedom = result.base.n_base, 6.0
    moves = np.random.default_rng(0).normal(size=(12, p))
    scatter = BlockScatter(moves, np.full(p, freedom), 0.0)
    nu = mean_degrees(scatter.degrees_of_freedom)
    assert 4.0 < nu < 7.0
    drawn = draw_ensemble(replace(result, scatter=scatter), 4000, rng=1)
    free = draw_ensemble(result, 4000, rng=1)
    errors = result.std_errors / widening(np.array([nu]))
    sigmas, normal = (
        (each.parameters @ result.base.regrouping.T - result.estimates) / errors
        for each in (drawn, free)
    )
    found = np.quantile(sigmas, [0.05, 0.95], axis=0)
    assert np.allclose(found, [[-student.ppf(0.95, nu)], [student.ppf(0.95, nu)]], atol=0.15)
    assert np.quantile(np.abs(sigmas), 0.99) > np.quantile(np.abs(normal), 0.99)


@pytest.mark.study
def test_workers_draw_the_same_robots_to_the_last_bit(result: IdentificationResult) -> None:
    n = 3 * AT_ONCE + 7
    here = draw_ensemble(result, n, rng=5)
    with open_workers(2) as workers:
        there = draw_ensemble(result, n, rng=5, workers=workers)
    assert here.table.tobytes() == there.table.tobytes()
    assert here.middle.tobytes() == there.middle.tobytes()
    assert here.chi_square.tobytes() == there.chi_square.tobytes()


def test_masses_that_nothing_determines_stay_near_cad_beside_an_impossible_draw() -> None:
    model = bundled_robot("ur10e")
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb"))
    prior = build_cad_prior(model, base.drive)
    beta = base.regrouping @ prior.parameters
    friction = [k for k, name in enumerate(base.names) if name.startswith(("Fv", "Fc"))]
    beta[friction] = 5.0
    impossible = beta.copy()
    impossible[friction[0]] = -1.0
    root = np.diag(1.0 / (0.01 * np.abs(beta) + 1e-4))
    chi, chi_square = make_draws_consistent(prior, base, np.stack([beta, impossible]), root)
    assert chi_square[0] < 0.02
    assert chi_square[1] > 100.0
    masses = chi[:, 9 : 10 * model.n_links : 10]
    np.testing.assert_allclose(masses / prior.parameters[9:60:10], 1.0, atol=0.05)
