"""The block bootstrap against formulas, against fits of the blocks drawn one by one, and against
the block-robust covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import Samples
from asbuilt.identification import (
    EstimationData,
    SquareRootInformation,
    build_cad_prior,
    design_values,
    estimate_block_uncertainty,
    fit_least_squares,
    identify_samples,
    methods,
    summarise,
)
from asbuilt.identification.estimators.consistent_fit import fit_consistent, fit_toward_cad
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.uncertainty.uncertainty import estimate_bootstrap_uncertainty, redraw

MODEL, DRIVE = load_robot("two-link"), DriveSet.parse("viscous,coulomb,offset")
BASE = find_base_parameters(MODEL, DRIVE)
CHI = np.concatenate(
    [
        np.concatenate([link.inertia.parameters for link in MODEL.links]),
        [0.8, 1.5, -0.2, 0.4, 0.9, 0.3],
    ]
)


def made_samples(seed: int = 3, n_samples: int = 4000, noise: float = 1.0) -> Samples:
    rng = np.random.default_rng(seed)
    t = np.arange(n_samples) / 100.0
    q = np.column_stack(
        [np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t), np.cos(1.7 * t) - 0.4 * np.sin(4.3 * t)]
    )
    qd, qdd = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    tau = (
        observation_matrix(MODEL, q, qd, qdd, drive=DRIVE, columns=BASE.columns) @ BASE.values(CHI)
    ).reshape(q.shape)
    return Samples(
        t,
        q,
        qd,
        qdd,
        tau + noise * rng.normal(size=q.shape),
        rate=100.0,
        joint_names=MODEL.joint_names,
    )


@pytest.fixture(scope="module")
def samples() -> Samples:
    return made_samples()


@pytest.fixture(scope="module")
def information(samples: Samples) -> SquareRootInformation:
    return accumulate(MODEL, BASE, samples, block_seconds=1.0)


def drawn_blocks(n: int, draws: int, seed: int) -> list[np.ndarray]:
    """The blocks of every draw, as a seed gives them: each as often as it is drawn."""
    counts = np.random.default_rng(seed).multinomial(n, np.full(n, 1.0 / n), size=draws)
    return [np.repeat(np.arange(n), times) for times in counts]


def test_white_residuals_give_the_textbook_errors(information: SquareRootInformation) -> None:
    estimate = fit_least_squares(information, weights="joint")
    found = redraw(information, estimate, rng=1)
    assert np.median(found.std(axis=0, ddof=1) / estimate.std_errors) == pytest.approx(1.0, abs=0.1)
    assert np.median(
        found.std(axis=0, ddof=1) / estimate_block_uncertainty(information, estimate).std_errors
    ) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("method", ["ols", "wls", "ridge", "total"])
def test_every_draw_of_a_linear_estimate_is_the_fit_of_the_blocks_drawn(
    information: SquareRootInformation, method: str
) -> None:
    design = design_values(MODEL, BASE)
    estimate = methods[method].estimate(EstimationData(MODEL, information, None, design))
    found = redraw(information, estimate, n_draws=6, rng=4)
    for beta, blocks in zip(found, drawn_blocks(information.n_blocks, 6, 4), strict=True):
        gram, side = normal_equations(information.select(blocks), estimate.weights)
        if method in ("ridge", "total"):
            held = normal_equations(information, estimate.weights)
            pull = (
                np.linalg.inv(estimate.solution.inverse_root @ estimate.solution.inverse_root.T)
                - held[0]
            )
            gram, side = gram + pull, side + (held[0] + pull) @ estimate.beta - held[1]
        np.testing.assert_allclose(beta, np.linalg.solve(gram, side), rtol=1e-6, atol=1e-8)


def normal_equations(
    information: SquareRootInformation, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    p = information.base.n_base
    gram, side = np.zeros((p, p)), np.zeros(p)
    for support, factors, weight in zip(
        information.support, information.factors, weights, strict=True
    ):
        for factor in factors:
            whole = weight**2 * factor.T @ factor
            gram[np.ix_(support, support)] += whole[:-1, :-1]
            side[support] += whole[:-1, -1]
    return gram, side


def test_every_draw_of_a_consistent_fit_is_the_consistent_fit_of_the_blocks_drawn(
    information: SquareRootInformation,
) -> None:
    prior = build_cad_prior(MODEL, DRIVE)
    for estimate, again in (
        (
            whole := fit_consistent(information, prior),
            lambda seen, w=whole.weights: fit_consistent(seen, prior, weights=w),
        ),
        (
            whole := fit_toward_cad(information, prior, weight=10.0),
            lambda seen, w=whole.weights: fit_toward_cad(seen, prior, weight=10.0, weights=w),
        ),
    ):
        found = redraw(information, estimate, n_draws=3, rng=2)
        for beta, blocks in zip(found, drawn_blocks(information.n_blocks, 3, 2), strict=True):
            np.testing.assert_allclose(
                beta, again(information.select(blocks)).beta, rtol=1e-4, atol=1e-5
            )


def test_dropped_parameters_stay_dropped_and_the_others_are_fitted_without_them(
    information: SquareRootInformation,
) -> None:
    estimate = methods["essential"].estimate(
        EstimationData(MODEL, information, None, design_values(MODEL, BASE))
    )
    assert estimate.dropped is not None
    assert 0 < estimate.dropped.sum() < BASE.n_base
    found = redraw(information, estimate, n_draws=4, rng=9)
    assert np.all(found[:, estimate.dropped] == 0.0)
    kept = ~estimate.dropped
    for beta, blocks in zip(found, drawn_blocks(information.n_blocks, 4, 9), strict=True):
        gram, side = normal_equations(information.select(blocks), estimate.weights)
        np.testing.assert_allclose(
            beta[kept], np.linalg.solve(gram[np.ix_(kept, kept)], side[kept]), rtol=1e-6, atol=1e-8
        )
    uncertainty = estimate_bootstrap_uncertainty(information, estimate, found)
    assert np.all(np.diag(uncertainty.covariance)[estimate.dropped] == 0.0)
    assert np.all(np.diag(uncertainty.covariance)[kept] > 0.0)


def test_intervals_contain_the_estimate_and_follow_the_seed(
    information: SquareRootInformation,
) -> None:
    estimate = fit_least_squares(information, weights="joint")
    one, other = (redraw(information, estimate, n_draws=50, rng=7) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    low, high = np.quantile(one, [0.005, 0.995], axis=0)
    assert np.all((low < estimate.beta) & (estimate.beta < high))


def test_what_nothing_excites_stays_where_it_is() -> None:
    samples = made_samples()
    still = replace(
        samples, q=samples.q * [0.0, 1.0], qd=samples.qd * [0.0, 1.0], qdd=samples.qdd * [0.0, 1.0]
    )
    information = accumulate(MODEL, BASE, still, block_seconds=1.0)
    estimate = fit_least_squares(information, weights="joint", prior=design_values(MODEL, BASE))
    assert estimate.undetermined
    found = redraw(information, estimate, n_draws=20)
    open_directions = (
        estimate.solution.open_directions
        / np.linalg.norm(estimate.solution.open_directions, axis=1)[:, None]
    )
    scaled = np.linalg.qr((estimate.solution.inverse_root), mode="complete")[0][:, estimate.rank :]
    assert open_directions.shape[0] == scaled.shape[1]
    np.testing.assert_allclose((found - estimate.beta) @ scaled, 0.0, atol=1e-9)


def test_too_few_blocks_are_refused(information: SquareRootInformation) -> None:
    few = information.select([0, 1, 2])
    with pytest.raises(IdentifiabilityError, match="too few"):
        redraw(few, fit_least_squares(few))


def test_a_block_that_alone_tells_a_direction_is_reported(samples: Samples) -> None:
    moving = (samples.t >= 20.0) & (samples.t < 20.9)
    lone = np.where(moving[:, None], 1.0, [0.0, 1.0])
    information = accumulate(
        MODEL,
        BASE,
        replace(samples, q=samples.q * lone, qd=samples.qd * lone, qdd=samples.qdd * lone),
        block_seconds=1.0,
    )
    estimate = fit_least_squares(information, weights="joint", prior=design_values(MODEL, BASE))
    with pytest.raises(
        IdentifiabilityError, match="single blocks have information that others lack"
    ):
        redraw(information, estimate)


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(name, marks=() if name in ("wls", "huber", "entropic") else pytest.mark.study)
        for name in methods
        if name != "total"
    ],
)
def test_identify_takes_its_errors_from_the_draws_whatever_the_method(
    samples: Samples, method: str
) -> None:
    blocks, drawn = (
        identify_samples(MODEL, samples, base=BASE, method=method, errors=errors, block_seconds=2.0)
        for errors in ("blocks", "bootstrap")
    )
    np.testing.assert_array_equal(blocks.estimates, drawn.estimates)
    known = np.isfinite(blocks.std_errors)
    assert 0.4 < np.median((drawn.std_errors / blocks.std_errors)[known]) < 1.5
    assert drawn.errors.kind == "bootstrap"
    assert drawn.errors.n_blocks == 20
    assert drawn.errors.n_draws >= 180
    assert ("the choice of " + drawn.method in drawn.errors.held_fixed) == (method == "auto")
    said = " ".join(summarise(drawn).as_text(full=True).split())
    assert f"scatter of {drawn.errors.n_draws} fits to 20 time blocks of 2 s" in said


def test_errors_that_do_not_exist_are_named(samples: Samples) -> None:
    with pytest.raises(UsageError, match="blocks, bootstrap, textbook"):
        identify_samples(MODEL, samples, base=BASE, errors="jackknife")  # type: ignore[arg-type]


@pytest.mark.study
def test_only_fits_that_bounds_hold_are_widened_for_few_blocks_and_warned_of(
    samples: Samples,
) -> None:
    """Student's quantile with 19 degrees of freedom is 2.093 (tables of Fisher and Yates).

    20 blocks drawn with replacement scatter sqrt(20 / 19) too little.
    """
    information = accumulate(MODEL, BASE, samples, block_seconds=2.0)
    prior = build_cad_prior(MODEL, DRIVE)
    for estimate, widening in (
        (fit_least_squares(information, weights="joint"), 1.0),
        (fit_consistent(information, prior), 2.093 / 1.96),
    ):
        drawn = redraw(information, estimate)
        wide = drawn.std(axis=0, ddof=1) * np.sqrt(20 / 19) * widening
        found = estimate_bootstrap_uncertainty(information, estimate, drawn).std_errors
        np.testing.assert_allclose(found, np.maximum(wide, estimate.std_errors), rtol=1e-3)
    for method, codes in (
        ("wls", []),
        ("consistent", ["bootstrap_near_bounds"]),
        ("entropic", ["bootstrap_of_regularised"]),
        ("ridge", ["bootstrap_of_regularised"]),
    ):
        result = identify_samples(
            MODEL, samples, base=BASE, method=method, errors="bootstrap", block_seconds=2.0
        )
        assert [
            warning.code for warning in result.findings if warning.code.startswith("bootstrap")
        ] == codes


@pytest.mark.parametrize(("smoothing", "small"), [(1, False), (25, True)])
def test_textbook_errors_are_those_of_the_textbook_and_labelled(
    smoothing: int, small: bool
) -> None:
    """Noise averaged over 25 neighbours is 25 times as good as it looks, sample by sample."""
    clean, rng = made_samples(noise=0.0), np.random.default_rng(8)
    noise = np.apply_along_axis(
        np.convolve,
        0,
        rng.normal(size=clean.tau.shape),
        np.ones(smoothing) / np.sqrt(smoothing),
        mode="same",
    )
    noisy = replace(clean, tau=clean.tau + noise)
    result, blocks = (
        identify_samples(MODEL, noisy, base=BASE, errors=errors, block_seconds=2.0)
        for errors in ("textbook", "blocks")
    )
    np.testing.assert_array_equal(result.covariance, result.textbook_covariance)
    np.testing.assert_array_equal(
        result.std_errors, [parameter.textbook_std_error for parameter in blocks.parameters]
    )
    assert result.effective_samples == result.n_samples
    assert (result.errors.kind, result.errors.asked) == ("textbook", "textbook")
    assert result.errors.growth == pytest.approx(np.median(blocks.std_errors / result.std_errors))
    assert "TOO SMALL" in result.errors_sentence
    assert any(warning.code == "textbook_errors" for warning in result.findings) == small
    assert (result.errors.growth > 2.0) == small
