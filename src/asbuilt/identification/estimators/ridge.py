"""Least squares drawn toward the design: a ridge whose weight blocks held out in turn decide."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.identification.estimators.least_squares import Estimate, Weighted, estimate_wls
from asbuilt.identification.estimators.methods import JOINT_WEIGHTS, REGULARISATION, estimator
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.square_root_information import SquareRootInformation

RIDGES = np.concatenate([[0.0], np.logspace(-10, 0, 41)])
"""Weights tried, in units of the squared length of a column."""
MOST_FOLDS = 8


@estimator(
    "ridge",
    "ridge toward CAD",
    "regularised toward CAD as far as held-out blocks support",
    held_fixed=(JOINT_WEIGHTS, REGULARISATION),
    regularised=True,
)
def estimate_ridge(data: EstimationData) -> Estimate:
    """Estimate beta with `min |(tau - W beta) / sigma|^2 + lambda |D (beta - beta_CAD)|^2`, D the
    lengths of the weighted columns.

    lambda is the one with the least squared error on time blocks held out in turn, neighbouring
    blocks together; none where that predicts best. Parameters on which the description is silent
    are drawn toward zero. Source: Hoerl & Kennard, Technometrics 12, 1970.
    """
    information = data.information
    start = estimate_wls(data)
    prior = np.zeros(data.base.n_base) if data.prior is None else np.nan_to_num(data.prior, nan=0.0)
    errors = np.zeros(len(RIDGES))
    with one_blas_thread():
        for learnt, judged in folds(information):
            weighted, test = (
                Weighted.of(learnt, start.weights, prior),
                judged.stacked(start.weights),
            )
            for i, ridge in enumerate(RIDGES):
                error = test @ np.append(-weighted.solve(ridge).x, 1.0)
                errors[i] += error @ error
        chosen = float(RIDGES[int(np.argmin(errors))]) if errors.any() else 0.0
        note = f"Ridge weight {chosen:.3g} of the squared column length, by held-out blocks"
        if errors.any() and errors[0] > 0:
            note += f" (error {100 * (np.sqrt(errors.min() / errors[0]) - 1):+.2g} % against none)"
        return start.renewed(
            "ridge",
            information,
            Weighted.of(information, start.weights, prior).solve(chosen),
            notes=(f"{note}.",),
        )


def folds(
    information: SquareRootInformation,
) -> Iterator[tuple[SquareRootInformation, SquareRootInformation]]:
    """Yield the blocks to learn from and those held out, up to 8 times, runs of neighbouring blocks
    held out in turn; nothing for one block.
    """
    count = min(MOST_FOLDS, information.n_blocks)
    if count < 2:
        return
    number = np.arange(information.n_blocks) * count // information.n_blocks
    for fold in range(count):
        yield (
            information.select(np.flatnonzero(number != fold)),
            information.select(np.flatnonzero(number == fold)),
        )
