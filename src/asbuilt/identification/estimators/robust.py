"""Robust estimators, for collisions, contacts and bursts of bad samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.identification.estimators.least_squares import (
    estimate_wls,
    fit_least_squares,
    solve_squares,
)
from asbuilt.identification.estimators.methods import ROW_WEIGHTS, estimator
from asbuilt.identification.information.estimate import Estimate, EstimationData, noise_floor
from asbuilt.identification.information.rows import RowBlock, Rows
from asbuilt.identification.information.square_root_information import reduce_rows
from asbuilt.scaled import Scaled


@dataclass(frozen=True, slots=True)
class RobustRules:
    """Hold thresholds of the losses, and when the iteration ends."""

    mad_to_sigma: float = 1.4826022185056018
    """Standard deviation of a normal distribution in medians of the absolute deviation."""
    huber: float = 1.345
    """Threshold of Huber's loss in robust standard deviations.

    95 % efficient for normal noise (Holland & Welsch, Communications in Statistics A6, 1977).
    """
    bisquare: float = 4.685
    """Threshold of Tukey's bisquare; also 95 % efficient (ibid.)."""
    most_iterations: int = 60
    """Most iterations of weights and scales."""
    scale_iterations: int = 25
    """Iterations after which the scales are held fixed, so that the steps converge."""
    step: float = 1e-6
    """Length of the last step, in standard errors of all parameters together."""
    rough_step: float = 1e-2
    """The same where outliers are counted, whose number and variance then have three digits."""
    least_slope: float = 0.1
    """Least mean of rho'', of a joint or along a direction."""
    outlying: float = 4.0
    """Residual of an outlier, in robust standard deviations."""


ROBUST = RobustRules()


@dataclass(frozen=True, slots=True)
class Loss:
    """Hold a loss rho(r) of standardised residuals: rho'(r) / r and rho''(r)."""

    weight: Callable[[Array], Array]
    slope: Callable[[Array], Array]


HUBER = Loss(
    lambda r: ROBUST.huber / np.maximum(np.abs(r), ROBUST.huber),
    lambda r: np.where(np.abs(r) <= ROBUST.huber, 1.0, 0.0),
)
"""Huber's loss, linear beyond the threshold (Huber, Ann. Math. Stat. 35, 1964)."""
BISQUARE = Loss(
    lambda r: np.maximum(1.0 - (r / ROBUST.bisquare) ** 2, 0.0) ** 2,
    lambda r: (
        np.maximum(1.0 - (r / ROBUST.bisquare) ** 2, 0.0) * (1.0 - 5.0 * (r / ROBUST.bisquare) ** 2)
    ),
)
"""Tukey's bisquare, constant beyond the threshold (Technometrics 16, 1974)."""


@estimator(
    "huber",
    "Huber's robust fit",
    "outliers have bounded influence",
    needs="samples",
    held_fixed=(ROW_WEIGHTS,),
)
def estimate_huber(data: EstimationData) -> Estimate:
    """Minimise `sum_k sum_t rho((tau_kt - W_kt beta) / sigma_k)`, rho Huber's loss.

    By iteratively reweighted least squares; sigma_k is 1.4826 times the median absolute residual of
    joint k. Errors follow from least squares on pseudo-values `W beta + sigma rho'(r) / s` with
    weights `sqrt(s) / sigma`, which has the same solution. Source: Huber, Robust Statistics, 1981,
    chapter 7, with s = mean(rho''); here `_average_informed_slope` lowers s, since outliers of a
    robot cluster where its joints reverse.
    """
    return continue_huber(data, estimate_wls(data))


def continue_huber(data: EstimationData, start: Estimate) -> Estimate:
    """Continue weighted least squares as `estimate_huber` does."""
    return _fit_robust(data, "huber", HUBER, start)


@estimator(
    "bisquare",
    "Tukey's robust fit",
    "gross outliers, such as collisions and contacts, have no influence",
    needs="samples",
    held_fixed=(ROW_WEIGHTS,),
)
def estimate_bisquare(data: EstimationData) -> Estimate:
    """Continue `estimate_huber` with Tukey's bisquare at its scale.

    Source: Yohai, Annals of Statistics 15, 1987 (a redescending step at a fixed robust scale).
    """
    start = estimate_huber(data)
    return _fit_robust(data, "bisquare", BISQUARE, start, scale=start.sigma)


@dataclass(frozen=True, slots=True, eq=False)
class Reweighted:
    """Hold where the iteration of weights and scales ended: beta (p,) and robust sigma (n,)."""

    beta: Array
    sigma: Array
    iterations: int
    converged: bool


@use_one_blas_thread()
def reweight(
    data: EstimationData,
    loss: Loss,
    start: Estimate,
    scale: Array | None = None,
    *,
    roughly: bool = False,
) -> Reweighted:
    """Repeat weighted least squares with weights by the residuals, from an estimate on.

    `roughly` is enough to count outliers: it ends sooner, solves by squares, and takes the rows of
    all blocks together, which is faster and rounds what data hardly determine otherwise.
    """
    information = data.information
    support = data.rows.support
    floor = noise_floor(data.information)
    root = start.solution.inverse_root / start.weights.max()
    beta = start.beta
    sigma = start.sigma if scale is None else scale
    iterations = 0
    converged = False
    parts = data.rows.parts if roughly else data.rows.by_block
    close = ROBUST.rough_step if roughly else ROBUST.step
    while not converged and iterations < ROBUST.most_iterations:
        residuals = _evaluate_residuals(parts(), support, beta)
        if scale is None and iterations < ROBUST.scale_iterations:
            medians = np.array([np.median(np.abs(_drop_uncounted(e))) for e in residuals])
            sigma = np.maximum(ROBUST.mad_to_sigma * medians, floor)
            # An infinite scale is a weight of 0.
            sigma[~information.has_torque] = np.inf
        whole = np.zeros((len(root) + 1, len(root) + 1))
        sums = [np.zeros((places.size, places.size + 1)) for places in support]
        for b, rows in enumerate(parts()):
            for k, (columns, total) in enumerate(zip(rows, sums, strict=True)):
                # Least squares of weights rho'(r) / r about the present residuals: a Newton-like
                # step in beta.
                share = np.sqrt(loss.weight(residuals[k][b] / sigma[k])) / sigma[k]
                weighted = columns * share
                weighted[-1] = residuals[k][b] * share
                # A product with itself takes half of the work of another.
                np.add(total, (weighted @ weighted.T)[:-1], out=total)
        for places, total in zip(support, sums, strict=True):
            whole[np.ix_(places, np.append(places, len(root)))] += total
        step = _solve_step(whole, root, roughly=roughly)
        beta = beta + step
        # In units of the information: the length is in standard errors of all parameters together.
        converged = bool(step @ whole[:-1, :-1] @ step <= close**2)
        iterations += 1
    return Reweighted(beta, sigma, iterations, converged)


def _solve_step(normal: Array, root: Array, *, roughly: bool) -> Array:
    """Return the step (p,) of normal equations (p + 1, p + 1); a root (p, r) has what counts."""
    # A tenth of the time of eigenvalues, and half of the digits.
    found = solve_squares(normal) if roughly else None
    if found is not None:
        return found[0]
    gram = root.T @ normal[:-1, :-1] @ root
    return np.asarray(root @ Scaled(gram).solve(root.T @ normal[:-1, -1]))


@use_one_blas_thread()
def _fit_robust(
    data: EstimationData, name: str, loss: Loss, start: Estimate, scale: Array | None = None
) -> Estimate:
    """Return the estimate that the iteration from a `start` reaches, with its errors."""
    reached = reweight(data, loss, start, scale)
    information = data.information
    rows = data.rows
    sigma = reached.sigma
    root = start.solution.inverse_root / start.weights.max()
    residuals = _evaluate_residuals(rows.by_block(), rows.support, reached.beta)
    standard = [np.concatenate(e) / s for e, s in zip(residuals, sigma, strict=True)]
    # A redescending loss with most rows beyond its threshold would have a slope of zero or less.
    slope = np.array([max(float(np.mean(loss.slope(r))), ROBUST.least_slope) for r in standard])
    slope = slope * _average_informed_slope(rows, residuals, sigma, slope, loss, root)

    def replace_torques() -> Iterator[RowBlock]:
        for b, block in enumerate(rows):
            made = []
            for k, columns in enumerate(block.rows):
                e = residuals[k][b]
                # Pseudo-values: least squares of these torques has the M-estimate as its solution.
                torque = columns[-1] - e + e * loss.weight(e / sigma[k]) / slope[k]
                made.append(np.vstack([columns[:-1], torque]))
            yield RowBlock(tuple(made), block.time, block.seconds)

    solved = reduce_rows(data.base, information.joint_names, rows.support, replace_torques())
    fitted = fit_least_squares(
        solved, weights=np.sqrt(slope) / sigma, prior=data.prior, undetermined=data.undetermined
    )
    outlying = np.array([float(np.mean(np.abs(r) > ROBUST.outlying)) for r in standard])
    worst = int(np.argmax(outlying))
    note = (
        f"{100 * outlying.mean():.2g} % of the torques are beyond {ROBUST.outlying:g} robust"
        f" standard deviations and have less weight, most at joint {information.joint_names[worst]}"
        f" ({100 * outlying[worst]:.2g} %)."
        if outlying.any()
        else f"No torque is beyond {ROBUST.outlying:g} robust standard deviations."
    )
    return replace(
        fitted,
        method=name,
        sigma=sigma,
        iterations=reached.iterations,
        converged=reached.converged,
        information=solved,
        notes=(note,),
    )


def _average_informed_slope(
    rows: Rows, residuals: list[list[Array]], sigma: Array, slope: Array, loss: Loss, root: Array
) -> float:
    """Return the part of the mean slopes (n,) that the information has.

    The covariance of an M-estimate is `A^-1 B A^-1` with `A = sum rho''(r) w w^T`. Pseudo-values
    use `A0 = sum mean(rho'') w w^T`: the variance is then too small by the mean of `m^-2` over the
    eigenvalues m of A in coordinates where A0 is 1, which one factor for all rows corrects. It is 1
    if outliers are distributed evenly over the motion.
    """
    p = root.shape[1]
    assumed = np.zeros((p, p))
    actual = np.zeros((p, p))
    for b, block in enumerate(rows):
        for k, (columns, support) in enumerate(zip(block.rows, rows.support, strict=True)):
            seen = root[support].T @ columns[:-1] / sigma[k]
            assumed += slope[k] * seen @ seen.T
            actual += (seen * loss.slope(residuals[k][b] / sigma[k])) @ seen.T
    turned = Scaled(assumed).inverse_root
    if not turned.size:
        return 1.0
    # Along a direction that outliers alone inform the slope may be negative.
    parts = np.maximum(np.linalg.eigvalsh(turned.T @ actual @ turned), ROBUST.least_slope)
    return float(min(1.0 / np.sqrt(np.mean(parts**-2.0)), 1.0))


def estimate_outlying_share(data: EstimationData, robust: Reweighted) -> tuple[float, float]:
    """Return the share of outliers, and the largest residual variance in robust variances."""
    residuals = _evaluate_residuals(data.rows.parts(), data.rows.support, robust.beta)
    standard = [_drop_uncounted(e) / s for e, s in zip(residuals, robust.sigma, strict=True)]
    share = float(np.mean([np.mean(np.abs(r) > ROBUST.outlying) for r in standard]))
    return share, max(float(np.mean(r**2)) for r in standard)


def _evaluate_residuals(
    parts: Iterable[tuple[Array, ...]], support: Sequence[Indices], beta: Array
) -> list[list[Array]]:
    """Return residuals per joint and part of the rows."""
    by_part = [
        [
            columns[-1] - beta[places] @ columns[:-1]
            for columns, places in zip(rows, support, strict=True)
        ]
        for rows in parts
    ]
    return [list(joint) for joint in zip(*by_part, strict=True)]


def _drop_uncounted(residuals: Sequence[Array]) -> Array:
    """Return the residuals of a joint without zeros, which are of rows that do not count."""
    # A row that does not count is zero in every column, torque included.
    together = np.concatenate(residuals)
    return together[together != 0.0] if together.any() else together
