"""Weighted least squares with insignificant parameters set to zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import fdtri

from asbuilt.arrays import Array
from asbuilt.dynamics import use_one_blas_thread
from asbuilt.findings import join_names
from asbuilt.identification import (
    JOINT_WEIGHTS,
    Estimate,
    EstimationData,
    estimate_block_uncertainty,
    estimate_wls,
    estimator,
    solve_factor,
    triangular_factor,
)

SIGNIFICANCE = 0.05
"""Significance level of the F-test below which a parameter is essential."""
MOST_LISTED = 12


@estimator(
    "essential",
    "weighted least squares, essential parameters",
    "parameters that an F-test finds insignificant set to zero",
    held_fixed=(JOINT_WEIGHTS, "the selection of parameters"),
)
@use_one_blas_thread()
def estimate_essential(data: EstimationData) -> Estimate:
    """Set parameters of the wls estimate to zero one by one while an F-test allows it.

    The parameter of least effect goes first. Dropping d of the r determined parameters is allowed
    while `F = (SSE_reduced - SSE) / (d s^2)`, times effective samples per sample since residuals
    are correlated, stays below the quantile of F(d, n N_eff - r). Weights are taken from
    the full fit.

    Source: Pham & Gautier, CDC 1991; Gautier & Khalil, IEEE Trans. Robotics and Automation 6, 1990;
    Hocking, Biometrics 32, 1976 (backward elimination).
    """
    information = data.information
    base = data.base
    start = estimate_wls(data)
    n_rows = information.n_rows
    effective = estimate_block_uncertainty(information, start).effective_samples
    share = min(1.0, effective / information.n_samples)
    freedom = max(n_rows * share - start.rank, 1.0)
    variance = start.solution.residual_energy / max(n_rows - start.rank, 1)
    kept = np.flatnonzero(start.determined)
    beta = start.beta.copy()
    loss = 0.0
    without = np.zeros(base.n_base, dtype=np.bool_)
    factor = information.stacked(start.weights)

    def reduce() -> Array:
        others = beta.copy()
        others[kept] = 0.0
        return triangular_factor(
            np.column_stack([factor[:, kept], factor[:, -1] - factor[:, :-1] @ others])
        )

    while len(kept) > 1:
        r = reduce()
        scale = np.linalg.norm(r[:-1, :-1], axis=0)
        inverse = np.linalg.inv(r[:-1, :-1] / scale)
        increase = (inverse @ r[:-1, -1]) ** 2 / np.sum(inverse**2, axis=1)
        weakest = int(np.argmin(increase))
        count = int(without.sum()) + 1
        if (loss + increase[weakest]) / count * share > variance * fdtri(
            count, freedom, 1.0 - SIGNIFICANCE
        ):
            break
        loss += float(increase[weakest])
        without[kept[weakest]] = True
        beta[kept[weakest]] = 0.0
        kept = np.delete(kept, weakest)
    root = start.solution.inverse_root
    solution = start.solution
    if without.any():
        solution = solve_factor(reduce(), n_rows)
        beta[kept] = solution.x
        root = np.zeros((base.n_base, solution.rank))
        root[kept] = solution.inverse_root
    names = [base.names[j] for j in np.flatnonzero(without)]
    note = (
        f"{len(kept)} of {base.n_base} parameters are essential at the {100 * SIGNIFICANCE:g} %"
        f" level; set to zero: {join_names(names, MOST_LISTED)}."
        if names
        else "Every parameter is essential."
    )
    conditioned = replace(
        start.solution,
        condition_number=solution.condition_number,
        scaled_condition_number=solution.scaled_condition_number,
    )
    return start.renewed(
        "essential",
        information,
        conditioned,
        beta=beta,
        inverse_root=root,
        notes=(note,),
        dropped=without,
    )
