"""Standard errors that allow for correlated residuals: by time blocks, recordings or bootstrap."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtrit

from asbuilt.arrays import Array
from asbuilt.codec import store_as
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError, ResultError
from asbuilt.findings import Cure
from asbuilt.identification.estimators.held_out_choice import group_different_motions
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.estimators.methods import JOINT_WEIGHTS, ROW_WEIGHTS, methods
from asbuilt.identification.information.estimate import Estimate, Refit
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import (
    pack_triangle,
    triangular_factor,
    unpack_symmetric,
)
from asbuilt.identification.uncertainty.block_scatter import (
    COVERED,
    BlockScatter,
    BlockScores,
    CommonGrowth,
    ErrorBasis,
    estimate_common_growth,
    widening,
)
from asbuilt.identification.uncertainty.error_kinds import ErrorKind

MOST_LEVERAGE = 0.999
"""Largest share of the information on a direction that one block is taken to have."""
FEWEST_BLOCKS = 8
FEWEST_RECORDINGS = 4
"""Blocks, and recordings, below which their scatter gives no usable variance."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Hold the covariance (p, p), the effective number of samples and how both were estimated.

    `scatter` is the scatter of the time blocks, by which parameters are tested; None without
    blocks. `shared` is the factor on variances by what blocks of like motion share.
    """

    covariance: Array
    effective_samples: float
    basis: ErrorBasis
    scatter: BlockScatter | None = None
    shared: float = 1.0

    @property
    def std_errors(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def with_further(self, covariance: Array, bias: Array | None = None) -> Uncertainty:
        """Return the uncertainty with further errors, as `BlockScatter.with_further` adds them."""
        scatter = None if self.scatter is None else self.scatter.with_further(covariance, bias)
        return replace(self, covariance=self.covariance + covariance, scatter=scatter)


def estimate_block_uncertainty(
    information: SquareRootInformation, estimate: Estimate
) -> Uncertainty:
    """Estimate the errors of an estimate from the score of each time block.

    With `M_b = S^T W_b^T W_b S` and `g_b = S^T W_b^T e_b` of block b, in coordinates where all
    blocks together have unit information (S the inverse root), the variance of a parameter is
    `sum_b (S (1 - M_b)^(-1/2) g_b)^2`: the cluster-robust covariance CR2, unbiased where residuals
    are independent after all (Bell & McCaffrey, Survey Methodology 28, 2002; Pustejovsky & Tipton,
    J. Business & Economic Statistics 36, 2018). It allows for any correlation within a block,
    across joints too. A variance from few blocks has few degrees of freedom nu, by Satterthwaite's
    rule (the variance of the quadratic form for independent residuals), less for what is common to
    all variances (`estimate_common_growth`). Standard errors are widened
    by the ratio of Student's quantile with nu to the normal one, so that `estimate +- 1.96
    std_error` is a 95 % interval. No variance is smaller than the textbook one, and correlations
    between parameters are the textbook ones, since B blocks do not determine p (p - 1) / 2 of them.

    `effective_samples` = N times the geometric mean over parameters of textbook variance /
    variance.
    """
    n_blocks = information.n_blocks
    n_samples = information.n_samples
    if n_blocks < FEWEST_BLOCKS or estimate.rank == 0:
        return Uncertainty(
            estimate.covariance,
            float(n_samples),
            choose_error_basis(information, "textbook", asked="blocks"),
        )
    grams, scores = block_scores(information, estimate)
    data = BlockScores(
        grams,
        scores,
        information.blocks,
        group_different_motions(information, estimate.weights),
        information.n_rows,
        unit_variance(estimate),
    )
    scattered = estimate_scatter(data, estimate.solution.inverse_root)
    textbook = np.diag(estimate.covariance)
    determined = textbook > 0
    swell = np.ones_like(textbook)
    variance = np.maximum(scattered.variance, textbook)[determined]
    # Dropped and undetermined parameters have no textbook variance to grow.
    swell[determined] = grown = np.sqrt(variance / textbook[determined])
    # Geometric mean of variance ratios, so that no parameter dominates.
    shrinkage = float(np.exp(-2.0 * np.mean(np.log(grown)))) if grown.size else 1.0
    growth = float(np.median(grown)) if grown.size else None
    return Uncertainty(
        estimate.covariance * np.outer(swell, swell),
        n_samples * shrinkage,
        replace(choose_error_basis(information, "blocks"), growth=growth),
        scattered.scatter,
        scattered.common.factor / scattered.common.of_noise,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Scattered:
    """Hold the variances (p,) of unknowns, widened, their scatter and what is common to all."""

    variance: Array
    scatter: BlockScatter
    common: CommonGrowth


def estimate_scatter(data: BlockScores, root: Array) -> Scattered:
    """Return the variances of p unknowns from time blocks (`estimate_block_uncertainty`).

    `root` (p, r) turns the r whitened unknowns of the fit into these. The fit of all r absorbs
    residuals, so none may be left out.
    """
    moves, absorbed, leverage, freedom = correct_moves(data.grams, data.scores, root)
    determined = np.any(root, axis=1)
    # One typical number: the common growth belongs to no single parameter.
    typical = float(np.median(freedom[determined])) if determined.any() else 1.0
    common = estimate_common_growth(data, moves, absorbed, leverage, typical)
    parts = np.sqrt(common.factor) * moves @ root.T
    scatter = BlockScatter.of(parts, freedom, common.variance)
    variance = np.sum(parts**2, axis=0) * widening(scatter.degrees_of_freedom) ** 2
    return Scattered(variance, scatter, common)


def unit_variance(estimate: Estimate) -> float:
    """Return the variance of a whitened parameter by the textbook."""
    length = float(np.sum(estimate.solution.inverse_root**2))
    return float(np.trace(estimate.covariance)) / length if length > 0.0 else 0.0


@use_one_blas_thread()
def correct_moves(grams: Array, scores: Array, root: Array) -> tuple[Array, Array, float, Array]:
    """Return scores of clusters corrected for their leverage as CR2 does, and what follows.

    The moves `(1 - M_b)^(-1/2) g_b` (B, rank), what the fit absorbs `(1 - M_b)^(-1/2) M_b`
    (B, rank, rank), the trace of all M_b, and the degrees of freedom (p,) of each variance, for
    clusters with information M_b (B, rank, rank) and scores g_b (B, rank).

    `root` (p, rank) is the inverse root, by which moves become changes of parameters.
    """
    moves = np.empty_like(scores)
    absorbed = np.empty_like(grams)
    trace = 0.0
    leverages = np.empty((len(grams), root.shape[1], root.shape[0]))
    weight = np.empty((len(grams), root.shape[0]))
    for b, (gram, score_b) in enumerate(zip(grams, scores, strict=True)):
        leverage, axes = np.linalg.eigh(gram)
        # One block can have all information of a direction: its residual is then zero, and says
        # nothing.
        leverage = np.clip(leverage, 0.0, MOST_LEVERAGE)
        moves[b] = axes @ ((axes.T @ score_b) / np.sqrt(1.0 - leverage))
        turned = axes.T @ root.T / np.sqrt(1.0 - leverage)[:, None]
        leverages[b] = axes @ (leverage[:, None] * turned)
        weight[b] = leverage @ turned**2
        # A matrix times its own transpose takes half of the time.
        half = axes * np.sqrt(leverage / np.sqrt(1.0 - leverage))
        absorbed[b] = half @ half.T
        trace += float(leverage.sum())
    freedom = _estimate_degrees_of_freedom(leverages, weight)
    return moves, absorbed, trace, freedom


def estimate_textbook_uncertainty(
    information: SquareRootInformation, estimate: Estimate
) -> Uncertainty:
    """Return the textbook covariance `s^2 (W^T W)^-1`, valid for independent residuals."""
    growth = estimate_block_uncertainty(information, estimate).basis.growth
    return Uncertainty(
        estimate.covariance,
        float(information.n_samples),
        replace(choose_error_basis(information, "textbook"), growth=growth),
    )


def choose_error_basis(
    information: SquareRootInformation, kind: ErrorKind, *, asked: ErrorKind | None = None
) -> ErrorBasis:
    """Return the basis of errors from this information."""
    lengths = [
        # n samples span n - 1 steps; the block lasts n.
        (block.stop - block.start) * block.n_samples / max(block.n_samples - 1, 1)
        for block in information.blocks
    ]
    return ErrorBasis(kind, asked or kind, information.n_blocks, float(np.median(lengths)))


@use_one_blas_thread()
def block_scores(information: SquareRootInformation, estimate: Estimate) -> tuple[Array, Array]:
    """Return `S^T W_b^T W_b S` (n_blocks, rank, rank) and `S^T W_b^T e_b` (n_blocks, rank).

    e is the weighted residual, S the inverse root.
    """
    root = estimate.solution.inverse_root
    # The torque is no part of whitened rows, and all of the residual.
    both = np.column_stack(
        [np.vstack([root, np.zeros(root.shape[1])]), np.append(-estimate.beta, 1.0)]
    )
    products = []
    for b in range(information.n_blocks):
        rows = information.multiply_block(b, estimate.weights, both)
        whitened = np.ascontiguousarray(rows[:, :-1])
        errors = rows[:, -1]
        products.append((whitened.T @ whitened, whitened.T @ errors))
    grams, scores = map(np.array, zip(*products, strict=True))
    return grams, scores


def _estimate_degrees_of_freedom(leverages: Array, weight: Array) -> Array:
    """Return Satterthwaite's `tr(G)^2 / tr(G^2)` of each parameter's variance, shape (p,).

    `G_bc = weight_b [b = c] - leverages_b . leverages_c`; `leverages` (n_blocks, rank, p) is `M_b
    (1 - M_b)^(-1/2) S^T`, `weight` (n_blocks, p) the diagonal of `S (1 - M_b)^(-1/2) M_b (1 -
    M_b)^(-1/2) S^T`.
    """
    squares = np.einsum("brp,brp->bp", leverages, leverages)
    trace = np.sum(weight - squares, axis=0)
    across = np.array([np.sum((along @ along.T) ** 2) for along in np.moveaxis(leverages, 2, 0)])
    # tr(G^2) with G = diag(weight) - L L^T, multiplied out.
    square = np.sum(weight**2 - 2.0 * weight * squares, axis=0) + across
    # Without leverage the variance has the freedom of so many independent blocks.
    most = np.full(len(square), float(len(leverages) - 1))
    return np.asarray(np.divide(trace**2, square, out=most, where=square > 0))


def estimate_recording_variances(information: SquareRootInformation, estimate: Estimate) -> Array:
    """Return the variances (p,) of base parameters with whole recordings as clusters.

    Blocks of one recording share what the model lacks in its motion, such as a law that only
    steps show; then the scatter of blocks is too small, and of recordings it is not
    (CR2, as in `estimate_block_uncertainty`, Student's quantile of its few degrees of freedom
    included).
    Zero if there are fewer than `FEWEST_RECORDINGS`.
    """
    sources = np.array([block.source for block in information.blocks])
    members = [sources == name for name in information.sources]
    if len(members) < FEWEST_RECORDINGS or estimate.rank == 0:
        return np.zeros(len(estimate.beta))
    of_blocks = block_scores(information, estimate)
    root = estimate.solution.inverse_root
    grams, scores = (
        np.array([of_all[chosen].sum(axis=0) for chosen in members]) for of_all in of_blocks
    )
    moves, _, _, freedom = correct_moves(grams, scores, root)
    return np.asarray(np.sum((moves @ root.T) ** 2, axis=0) * widening(freedom) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class FreeValues:
    """Hold the p base parameters by weighted least squares without bounds or regularisation.

    `estimates` (p,), their block-robust `covariance` (p, p), the `textbook_std_errors` (p,) that
    were widened for it, which are `determined` (p,), and the `scatter` of the time blocks.
    """

    estimates: Array
    covariance: Array = field(metadata=store_as(encode=pack_triangle, decode=unpack_symmetric))
    textbook_std_errors: Array
    determined: NDArray[np.bool_]
    scatter: BlockScatter | None = None

    def __post_init__(self) -> None:
        p = len(self.estimates)
        shapes = [self.covariance.shape, self.textbook_std_errors.shape, self.determined.shape]
        if shapes != [(p, p), (p,), (p,)]:
            raise ResultError(f"{p} free values need as many errors, got {shapes}; identify again")
        for values in (self.estimates, self.covariance, self.textbook_std_errors, self.determined):
            values.setflags(write=False)

    @property
    def std_errors(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))


def fit_free_values(
    information: SquareRootInformation,
    toward: ArrayLike,
    further: Array | None = None,
    bias: Array | None = None,
) -> FreeValues:
    """Fit by `wls` with errors from time blocks.

    Parameters
    ----------
    information
        Information of the recordings.
    toward
        Values (p,) of directions that the recordings leave undetermined; NaN counts as zero.
    further
        Covariance (p, p) of further errors, such as of fitted nonlinear parameters.
    bias
        Bias (p,) whose square is part of it.
    """
    fitted = fit_least_squares(information, weights="joint", prior=toward)
    uncertainty = estimate_block_uncertainty(information, fitted)
    if further is not None:
        uncertainty = uncertainty.with_further(further, bias)
    # Rounding leaves the product slightly off symmetry.
    covariance = 0.5 * (uncertainty.covariance + uncertainty.covariance.T)
    return FreeValues(
        fitted.beta, covariance, fitted.std_errors, fitted.determined, uncertainty.scatter
    )


Seed = np.random.Generator | int | None


# Hold how many draws a bootstrap makes, and which are valid.

DRAW_LINEAR_DRAWS = 1000  # Draws of an estimate that is linear in the torque
DRAW_REFITTED_DRAWS = 200  # Draws of any other estimate, each of which is a fit of its own
DRAW_LEAST_INFORMATION = 1e-6  # Part of the information in every direction that a valid draw has
DRAW_MOST_FAILURES = 0.1  # Largest share of invalid draws
BY_FORMULA = Cure(
    "record longer, or estimate the errors by the block formula", settings={"errors": "blocks"}
)


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
            cure=BY_FORMULA,
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
            cure=BY_FORMULA,
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
