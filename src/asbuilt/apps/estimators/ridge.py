"""Least squares regularised toward CAD, with a weight chosen on held-out time blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.dynamics import use_one_blas_thread
from asbuilt.identification import (
    JOINT_WEIGHTS,
    REGULARISATION,
    Estimate,
    EstimationData,
    FactorSolution,
    SquareRootInformation,
    build_cad_prior,
    divide_into_folds,
    estimate_wls,
    estimator,
    solve_factor,
    with_drive_rows,
    with_drive_scale,
)

RIDGES = np.concatenate([[0.0], np.logspace(-10, 0, 41)])
"""Weights tried, in units of the squared length of a column."""


@estimator(
    "ridge",
    "ridge toward CAD",
    "regularised toward CAD as far as held-out blocks support",
    held_fixed=(JOINT_WEIGHTS, REGULARISATION),
    regularised=True,
)
@use_one_blas_thread()
def estimate_ridge(data: EstimationData) -> Estimate:
    """Minimise `|(tau - W beta) / sigma|^2 + lambda |D (beta - beta_CAD)|^2`.

    D holds the lengths of the weighted columns, the prior of drives included. lambda minimises the
    squared error on groups of neighbouring time blocks held out in turn, and may be zero.
    Parameters without a CAD value are regularised toward zero, and parameters of drives have a
    scale too (`with_drive_scale`): without it a column that is short, of a joint that hardly moves,
    would hardly be regularised. Source: Hoerl & Kennard, Technometrics 12, 1970.
    """
    information = data.information
    base = data.base
    start = estimate_wls(data)
    drives = with_drive_scale(build_cad_prior(data.model, base.drive), information)

    def fit(part: SquareRootInformation, ridge: float) -> FactorSolution:
        return solve_factor(
            with_drive_rows(part.stacked(start.weights), base, drives),
            part.n_rows,
            data.prior_values,
            ridge,
        )

    errors = np.zeros(len(RIDGES))
    for training, held in divide_into_folds(information):
        for i, ridge in enumerate(RIDGES):
            error = held.stacked(start.weights) @ np.append(-fit(training, ridge).x, 1.0)
            errors[i] += error @ error
    chosen = float(RIDGES[int(np.argmin(errors))]) if errors.any() else 0.0
    note = f"Ridge weight {chosen:.3g} of the squared column length, chosen on held-out blocks"
    if errors.any() and errors[0] > 0:
        change = 100 * (np.sqrt(errors.min() / errors[0]) - 1)
        note += f" (torque error {change:+.2g} % compared with no regularisation)"
    return start.renewed(
        "ridge",
        information,
        replace(fit(information, chosen), rank=start.rank),
        notes=(f"{note}.",),
    )
