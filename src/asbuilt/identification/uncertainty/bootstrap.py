"""Bootstrap of time blocks: standard errors of any estimator."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError
from asbuilt.findings import Cure
from asbuilt.identification.estimators.methods import JOINT_WEIGHTS, ROW_WEIGHTS, methods
from asbuilt.identification.information.estimate import Estimate, Refit
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.identification.uncertainty.block_scatter import COVERED
from asbuilt.identification.uncertainty.uncertainty import (
    FEWEST_BLOCKS,
    Uncertainty,
    block_scores,
    choose_error_basis,
)

Seed = np.random.Generator | int | None


# Hold how many draws a bootstrap makes, and which are valid.

DRAW_LINEAR_DRAWS = 1000  # Draws of an estimate that is linear in the torque
DRAW_REFITTED_DRAWS = 200  # Draws of any other estimate, each of which is a fit of its own
DRAW_LEAST_INFORMATION = 1e-6  # Part of the information in every direction that a valid draw has
DRAW_MOST_FAILURES = 0.1  # Largest share of invalid draws


@use_one_blas_thread()
def redraw(
    information: SquareRootInformation,
    estimate: Estimate,
    *,
    n_draws: int | None = None,
    rng: Seed = 0,
) -> Array:
    """Return estimates (n_draws, p) of fits to time blocks drawn with replacement.

    The choices of the estimate are held fixed.

    Each draw has as many blocks as the recording; residuals may be correlated within a block
    (Kuensch, Annals of Statistics 17, 1989; here blocks do not overlap). An estimate that is linear
    in the torque takes the step `S (1 + sum (c_b - 1) M_b)^-1 sum (c_b - 1) g_b` with `M_b = S^T
    W_b^T W_b S`, `g_b = S^T W_b^T e_b` of block b and c_b the times that it is drawn. Any other is
    refitted to the factor of the blocks drawn.

    Raises
    ------
    IdentifiabilityError
        If there are fewer than 8 blocks, or more than a tenth of the draws do not determine a
        direction that the whole recording determines.
    """
    n = information.n_blocks
    if n < FEWEST_BLOCKS:
        raise IdentifiabilityError(
            f"{n} time blocks are too few for a bootstrap, {FEWEST_BLOCKS} are needed",
            cure=Cure(
                "record longer, or estimate the errors by the block formula",
                settings={"errors": "blocks"},
            ),
        )
    draws = (
        (DRAW_LINEAR_DRAWS if estimate.refit is None else DRAW_REFITTED_DRAWS)
        if n_draws is None
        else n_draws
    )
    counts = np.random.default_rng(rng).multinomial(n, np.full(n, 1.0 / n), size=draws)
    estimates = (
        _step_estimates(information, estimate, counts)
        if estimate.refit is None
        else _refit_draws(information, estimate.weights, estimate.refit, counts)
    )
    refused = draws - len(estimates)
    if refused > DRAW_MOST_FAILURES * draws or len(estimates) < 2:
        raise IdentifiabilityError(
            f"{refused} of {draws} bootstrap draws of {n} time blocks do not determine what the"
            " whole recording determines, since single blocks have information that others lack",
            cure=Cure(
                "record longer, or estimate the errors by the block formula",
                settings={"errors": "blocks"},
            ),
        )
    return np.array(estimates)


def _step_estimates(
    information: SquareRootInformation, estimate: Estimate, counts: NDArray[np.int64]
) -> list[Array]:
    root = estimate.solution.inverse_root
    gram, score = block_scores(information, estimate)
    estimates = []
    # Times drawn beyond once: an undisturbed block changes nothing.
    for extra in counts - 1.0:
        # 1 + sum (c_b - 1) M_b: its eigenvalues are the information left along each direction.
        values, axes = np.linalg.eigh(np.eye(root.shape[1]) + np.tensordot(extra, gram, axes=1))
        if values.min(initial=1.0) >= DRAW_LEAST_INFORMATION:
            estimates.append(estimate.beta + root @ (axes @ ((axes.T @ (extra @ score)) / values)))
    return estimates


def _refit_draws(
    information: SquareRootInformation, weights: Array, refit: Refit, counts: NDArray[np.int64]
) -> list[Array]:
    # Factors once: each draw stacks them again, times the root of how often a block was drawn.
    blocks = [information.stacked(weights, b) for b in range(information.n_blocks)]
    estimates = []
    for times in counts:
        rows = [np.sqrt(c) * block for c, block in zip(times, blocks, strict=True) if c]
        # A draw that fails is refused, and counted by its absence.
        with suppress(AsbuiltError):
            estimates.append(refit(triangular_factor(np.vstack(rows))))
    return estimates


def estimate_bootstrap_uncertainty(
    information: SquareRootInformation, estimate: Estimate, drawn: Array
) -> Uncertainty:
    """Return the scatter of the draws as standard errors, at least the textbook ones.

    They are multiplied by sqrt(B / (B - 1)) for B blocks, since drawing with replacement makes them
    too small, and for nonlinear fits also by the ratio of Student's quantile with B - 1 degrees of
    freedom to the normal one. Linear fits need no such factor, since draws without influential
    blocks scatter more; bounds prevent that. 95 % intervals then cover 95 to 97 %
    (benchmarks/coverage.py).
    """
    n = information.n_blocks
    few = 1.0 if estimate.refit is None else float(stdtrit(n - 1, COVERED) / ndtri(COVERED))
    textbook = np.diag(estimate.covariance)
    determined = textbook > 0
    covariance = np.atleast_2d(np.cov(drawn, rowvar=False)) * (few**2 * n / (n - 1.0))
    # A bound that all draws hit leaves no scatter.
    still = np.flatnonzero(determined & (np.diag(covariance) == 0.0))
    covariance[still, still] = textbook[still]
    drawn_variance = np.maximum(np.diag(covariance), np.finfo(np.float64).tiny)
    # Only upwards: no draw makes an error smaller than independent residuals would.
    swell = np.sqrt(np.maximum(textbook / drawn_variance, 1.0)) * determined
    covariance = covariance * np.outer(swell, swell)
    ratio = np.diag(covariance)[determined] / textbook[determined]
    basis = replace(
        choose_error_basis(information, "bootstrap"),
        n_draws=len(drawn),
        held_fixed=list_fixed_choices(estimate),
        growth=float(np.sqrt(np.median(ratio))) if determined.any() else None,
    )
    share = float(np.exp(-np.mean(np.log(ratio)))) if determined.any() else 1.0
    return Uncertainty(covariance, information.n_samples * share, basis)


def list_fixed_choices(estimate: Estimate) -> tuple[str, ...]:
    """Return what all bootstrap fits of an estimate share besides the blocks."""
    method = methods[estimate.method]
    reweighted = method.needs == "information" and estimate.information is not None
    return tuple(
        ROW_WEIGHTS if reweighted and choice == JOINT_WEIGHTS else choice
        for choice in method.held_fixed
    )
