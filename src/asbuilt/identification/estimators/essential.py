"""Only the parameters that the torques call for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import fdtri

from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.identification.errors.uncertainty import block_uncertainty
from asbuilt.identification.estimators.least_squares import Estimate, Weighted, estimate_wls
from asbuilt.identification.estimators.methods import JOINT_WEIGHTS, estimator
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.triangular import triangular_factor

SIGNIFICANCE = 0.05
"""Chance of an F as large without any effect, from which a parameter is called essential."""
MOST_LISTED = 12


@estimator(
    "essential",
    "weighted least squares, essential parameters",
    "parameters that an F-test finds insignificant set to zero",
    held_fixed=(JOINT_WEIGHTS, "the selection of parameters"),
)
def estimate_essential(data: EstimationData) -> Estimate:
    """Estimate by weighted least squares, then set parameters to zero one by one, that of least
    effect first, while an F-test allows it.

    Dropping d of the r determined parameters is allowed while `F = (SSE_reduced - SSE) / (d s^2)`,
    times effective samples per sample since residuals are correlated, stays below the quantile of
    F(d, n N_eff - r). Source: Pham & Gautier, CDC 1991; Gautier & Khalil, IEEE Trans. Robotics and
    Automation 6, 1990; Hocking, Biometrics 32, 1976 (backward elimination). Weights are those of
    the full fit.
    """
    information, base = data.information, data.base
    start = estimate_wls(data)
    effective = block_uncertainty(information, start).effective_samples
    share = min(1.0, effective / information.n_samples)
    n_rows = information.n_samples * information.n_joints
    freedom = max(n_rows * share - start.rank, 1.0)
    variance = start.solution.residual_energy / max(n_rows - start.rank, 1)
    kept = np.flatnonzero(start.determined)
    dropped: list[int] = []
    with one_blas_thread():
        factor = information.stacked(start.weights)
        loss = 0.0
        fixed = start.beta.copy()
        while len(kept) > 1:
            rest = factor[:, -1] - factor[:, :-1] @ np.where(
                np.isin(np.arange(base.n_base), kept), 0.0, fixed
            )
            r = triangular_factor(np.column_stack([factor[:, kept], rest]))
            scale = np.linalg.norm(r[:-1, :-1], axis=0)
            inverse = np.linalg.inv(r[:-1, :-1] / scale)
            increase = (inverse @ r[:-1, -1]) ** 2 / np.sum(inverse**2, axis=1)
            weakest = int(np.argmin(increase))
            count = len(dropped) + 1
            if (loss + increase[weakest]) / count * share > variance * fdtri(
                count, freedom, 1.0 - SIGNIFICANCE
            ):
                break
            loss += float(increase[weakest])
            dropped.append(int(kept[weakest]))
            fixed[kept[weakest]] = 0.0
            kept = np.delete(kept, weakest)
        beta = fixed.copy()
        root, solution = start.solution.inverse_root, start.solution
        if dropped:
            rest = factor[:, -1] - factor[:, :-1] @ np.where(
                np.isin(np.arange(base.n_base), kept), 0.0, fixed
            )
            solution = Weighted.factored(
                triangular_factor(np.column_stack([factor[:, kept], rest])), n_rows
            ).solve()
            beta[kept] = solution.x
            root = np.zeros((base.n_base, solution.rank))
            root[kept] = solution.inverse_root
    names = [base.names[j] for j in sorted(dropped)]
    listed = ", ".join(names[:MOST_LISTED]) + (
        f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    )
    note = (
        f"{len(kept)} of {base.n_base} parameters are essential at the {100 * SIGNIFICANCE:g} %"
        f" level; set to zero: {listed}."
        if names
        else "Every parameter is essential."
    )
    conditioned = replace(
        start.solution,
        condition_number=solution.condition_number,
        scaled_condition_number=solution.scaled_condition_number,
    )
    without = np.isin(np.arange(base.n_base), dropped)
    return start.renewed(
        "essential",
        information,
        conditioned,
        beta=beta,
        inverse_root=root,
        notes=(note,),
        dropped=without,
    )
