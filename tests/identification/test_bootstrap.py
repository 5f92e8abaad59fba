"""The block bootstrap against formulas and against the block-robust covariance."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description.load import load_robot
from asbuilt.dynamics.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.samples import Samples
from asbuilt.identification.bootstrap import block_bootstrap
from asbuilt.identification.identify import identify
from asbuilt.identification.least_squares import fit_least_squares
from asbuilt.identification.square_root_information import SquareRootInformation, accumulate
from asbuilt.identification.uncertainty import block_uncertainty


@pytest.fixture(scope="module")
def information() -> SquareRootInformation:
    model, drive = load_robot("two-link"), DriveSet.parse("viscous,coulomb,offset")
    base, rng = find_base_parameters(model, drive), np.random.default_rng(3)
    t = np.arange(8000) / 100.0
    q = np.column_stack([np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t), np.cos(1.7 * t) - 0.4 * np.sin(4.3 * t)])
    qd, qdd = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    beta = np.linspace(-1.0, 1.0, base.n_base)
    tau = (observation_matrix(model, q, qd, qdd, drive=drive, columns=base.columns) @ beta).reshape(q.shape) + rng.normal(size=q.shape)
    samples = Samples(t, q, qd, qdd, tau, rate=100.0, joint_names=model.joint_names)
    return accumulate(model, base, samples, block_seconds=1.0)


def weighted(information: SquareRootInformation) -> np.ndarray:
    return fit_least_squares(information, weights="joint").beta


def test_white_residuals_give_the_textbook_errors(information: SquareRootInformation) -> None:
    estimate = fit_least_squares(information, weights="joint")
    found = block_bootstrap(information, weighted, n_draws=400, rng=1)
    np.testing.assert_allclose(found.std_errors, estimate.std_errors, rtol=0.35)
    assert np.median(found.std_errors / estimate.std_errors) == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(np.diag(found.covariance), found.std_errors**2)
    assert np.median(found.std_errors / block_uncertainty(information, estimate).std_errors) == pytest.approx(1.0, abs=0.2)


def test_intervals_contain_the_estimate_and_follow_the_seed(information: SquareRootInformation) -> None:
    one, other = (block_bootstrap(information, weighted, n_draws=50, rng=7) for _ in range(2))
    np.testing.assert_array_equal(one.estimates, other.estimates)
    low, high = one.intervals(0.99).T
    beta = weighted(information)
    assert np.all((low < beta) & (beta < high))


def test_too_few_blocks_are_refused(information: SquareRootInformation) -> None:
    with pytest.raises(IdentifiabilityError, match="too few"):
        block_bootstrap(information.select([0, 1, 2]), weighted)


def test_an_estimator_that_mostly_refuses_is_reported(information: SquareRootInformation) -> None:
    def refuses(_: SquareRootInformation) -> np.ndarray:
        raise IdentifiabilityError("no")

    with pytest.raises(IdentifiabilityError, match="refused"):
        block_bootstrap(information, refuses, n_draws=5)


def test_identify_takes_its_errors_from_the_draws() -> None:
    model, drive, rng = load_robot("two-link"), DriveSet.parse("viscous,coulomb,offset"), np.random.default_rng(5)
    t = np.arange(6000) / 100.0
    q = np.column_stack([np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t), np.cos(1.7 * t) - 0.4 * np.sin(4.3 * t)])
    qd, qdd = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    base = find_base_parameters(model, drive)
    tau = (observation_matrix(model, q, qd, qdd, drive=drive, columns=base.columns) @ np.ones(base.n_base)).reshape(q.shape)
    samples = Samples(t, q, qd, qdd, tau + rng.normal(size=q.shape), rate=100.0, joint_names=model.joint_names)
    blocks, drawn = (identify(model, samples, base=base, errors=errors, block_seconds=2.0) for errors in ("blocks", "bootstrap"))
    np.testing.assert_array_equal(blocks.estimates, drawn.estimates)
    assert np.median(drawn.std_errors / blocks.std_errors) == pytest.approx(1.0, abs=0.3)
    with pytest.raises(UsageError, match="information alone"):
        identify(model, samples, base=base, method="huber", errors="bootstrap")
