import numpy as np
import pytest
from scipy import stats

from asbuilt.description import LinkInertia, load_robot
from asbuilt.dynamics import find_base_parameters
from asbuilt.errors import UsageError
from asbuilt.validation import CadTolerance, benjamini_hochberg
from asbuilt.validation.comparison.significance import chi_square, holm, size_probability


def test_false_discovery_rates_are_those_of_scipy() -> None:
    p = np.random.default_rng(0).uniform(size=40) ** 3
    np.testing.assert_allclose(benjamini_hochberg(p), stats.false_discovery_control(p), rtol=1e-12)
    assert benjamini_hochberg([]).shape == holm([]).shape == (0,)


def test_holm_rejects_what_its_steps_reject() -> None:
    p = np.random.default_rng(1).uniform(size=25) ** 4
    order = np.argsort(p)
    rejected = np.zeros(25, dtype=bool)
    for step, i in enumerate(order):
        if p[i] > 0.05 / (25 - step):
            break
        rejected[i] = True
    assert np.array_equal(holm(p) <= 0.05, rejected)
    assert np.all(holm(p) >= benjamini_hochberg(p))


def test_chi_square_is_that_of_the_distribution_and_takes_singular_covariances() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 4)) * [1, 30.0, 0.1, 1]
    found = [chi_square(A @ rng.normal(size=4), A @ A.T) for _ in range(300)]
    assert {test.degrees for test in found} == {4}
    assert stats.kstest([test.statistic for test in found], stats.chi2(4).cdf).pvalue > 1e-3
    assert stats.kstest([test.probability for test in found], "uniform").pvalue > 1e-3
    assert chi_square([1.0], [[0.0]]).probability == 1.0


@pytest.mark.parametrize(
    "sizes", [(3.0, 1.0, 0.5, 0.2, 0.1), (1.0, 1.0, 1.0, 1.0, 1.0), (1.0, 0.9, 0.1, 0.0, 0.0)]
)
def test_long_normal_vectors_are_as_rare_as_their_probability_says(
    sizes: tuple[float, ...],
) -> None:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(8, 5)) * sizes
    found = np.array(
        [size_probability(vector, A @ A.T) for vector in rng.normal(size=(4000, 5)) @ A.T]
    )
    assert 0.035 < np.mean(found < 0.05) < 0.065
    assert 0.005 < np.mean(found < 0.01) < 0.018
    assert size_probability([0.0], [[0.0]]) == 1.0


def test_tolerance_of_a_body_is_that_of_bodies_drawn_from_it() -> None:
    model = load_robot("two-link")
    base = find_base_parameters(model)
    tolerance = CadTolerance(mass=0.04, centre=0.03, inertia=0.02)
    rng = np.random.default_rng(3)
    drawn = []
    for _ in range(4000):
        chi = []
        for link in model.links:
            inertia = link.inertia
            about = inertia.inertia_about_com
            noise = rng.normal(size=(3, 3)) * tolerance.inertia * np.trace(about) / 3
            noise = np.triu(noise) + np.triu(noise, 1).T
            gyration = np.sqrt(np.trace(about) / (2 * inertia.mass))
            chi.append(
                LinkInertia.from_com(
                    inertia.mass * (1 + tolerance.mass * rng.normal()),
                    inertia.com + tolerance.centre * gyration * rng.normal(size=3),
                    about + noise,
                ).parameters
            )
        drawn.append(base.values(np.concatenate(chi)))
    np.testing.assert_allclose(
        np.cov(np.array(drawn).T), tolerance.covariance(model, base), rtol=0.15, atol=2e-4
    )


def test_wide_tolerances_hold_the_truth_as_often_as_they_say() -> None:
    """CAD that is off by its tolerances is beyond them in about 5 % of cases.

    A first-order rule would say so in 20 %.
    """
    model = load_robot("ur10e")
    base = find_base_parameters(model)
    tolerance = CadTolerance(0.15, 0.15, 0.15)
    covariance = tolerance.covariance(model, base)
    rng = np.random.default_rng(3)
    probabilities = []
    for _ in range(300):
        chi = []
        for link in model.links:
            inertia, about = link.inertia, link.inertia.inertia_about_com
            noise = 0.15 * np.trace(about) / 3 * rng.normal(size=(3, 3))
            centre = inertia.com + 0.15 * np.sqrt(
                np.trace(about) / (2 * inertia.mass)
            ) * rng.normal(size=3)
            moved = LinkInertia.from_com(
                inertia.mass * (1 + 0.15 * rng.normal()),
                centre,
                about + np.triu(noise) + np.triu(noise, 1).T,
            )
            chi.append(moved.parameters - inertia.parameters)
        probabilities.append(chi_square(base.values(np.concatenate(chi)), covariance).probability)
    assert np.mean(np.array(probabilities) < 0.05) < 0.11


@pytest.mark.parametrize("text", ["", "x", "5%,5%", "-1%", "120%", "5"])
def test_tolerances_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="tolerance"):
        CadTolerance.parse(text)
