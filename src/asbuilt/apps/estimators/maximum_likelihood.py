"""Maximum likelihood for torque noise that is correlated across joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular

from asbuilt.dynamics import use_one_blas_thread
from asbuilt.identification import (
    ROWS_AT_ONCE,
    WEIGHT_CONVERGENCE,
    Estimate,
    EstimationData,
    GrowingFactor,
    RowBlock,
    estimate_wls,
    estimator,
    fit_least_squares,
    noise_floor,
    reduce_rows,
    solve_factor,
    triangular_factor,
    widen_factor,
)

MOST_ITERATIONS = 100


@estimator(
    "ml",
    "maximum likelihood",
    "noise correlated across joints, its covariance estimated too",
    needs="samples",
    held_fixed=("the noise covariance of the joints",),
)
@use_one_blas_thread()
def estimate_ml(data: EstimationData) -> Estimate:
    """Minimise `N log det Omega + sum_t e_t^T Omega^-1 e_t` over beta and Omega (n, n).

    Omega is the covariance of the noise of the joints, independent from sample to sample:
    generalised least squares with `Omega = E^T E / N` of the residuals E, iterated to convergence.
    One pass reduces `[W_1 .. W_n | tau_1 .. tau_n]` to its triangle, which serves all iterations.

    Source: Zellner, JASA 57, 1962 (seemingly unrelated regressions); Oberhofer & Kmenta,
    Econometrica 42, 1974 (iterated: maximum likelihood).
    """
    information = data.information
    rows = data.rows
    base = data.base
    n = information.n_joints
    p = base.n_base
    n_samples = information.n_samples
    floor = noise_floor(information)
    every = np.arange(p)
    growing = GrowingFactor(sum(len(support) + 1 for support in rows.support), ROWS_AT_ONCE)
    for block in rows:
        growing.append(np.vstack(block.rows))
    ends = np.cumsum([len(support) + 1 for support in rows.support])[:-1]
    parts = np.split(growing.factor(), ends, axis=1)
    stack = np.array([widen_factor(*each, p) for each in zip(parts, rows.support, strict=True)])
    beta = estimate_wls(data).beta
    whitener = np.eye(n)
    iterations = 0
    converged = False
    while not converged and iterations < MOST_ITERATIONS:
        errors = stack @ np.append(-beta, 1.0)
        covariance = errors @ errors.T / (n_samples - p / n) + floor**2 * np.eye(n)
        renewed = solve_triangular(np.linalg.cholesky(covariance), np.eye(n), lower=True)
        change = np.max(np.abs(renewed - whitener))
        converged = bool(change <= WEIGHT_CONVERGENCE * np.max(np.abs(renewed)))
        whitener = renewed
        whitened = np.tensordot(whitener, stack, axes=1).reshape(-1, p + 1)
        beta = solve_factor(triangular_factor(whitened), n_samples * n, data.prior_values).x
        iterations += 1

    def mix_rows() -> Iterator[RowBlock]:
        for block in rows:
            own = np.zeros((n, p + 1, block.time.n_samples))
            for k, (columns, support) in enumerate(zip(block.rows, rows.support, strict=True)):
                own[k, np.append(support, p)] = columns
            yield RowBlock(tuple(np.tensordot(whitener, own, axes=1)), block.time, block.seconds)

    solved = reduce_rows(base, information.joint_names, [every] * n, mix_rows())
    fitted = fit_least_squares(
        solved, weights=np.ones(n), prior=data.prior, undetermined=data.undetermined
    )
    deviation = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviation, deviation) - np.eye(n)
    i, j = divmod(int(np.argmax(np.abs(correlation))), n)
    note = (
        f"Residuals are most correlated between {information.joint_names[i]} and"
        f" {information.joint_names[j]} ({correlation[i, j]:+.2f}); the estimate accounts for it."
    )
    return replace(
        fitted,
        method="ml",
        sigma=np.where(information.has_torque, deviation, np.inf),
        iterations=iterations,
        converged=converged,
        information=solved,
        notes=(note,) if n > 1 else (),
    )
