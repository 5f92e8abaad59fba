"""Standard errors that hold although neighbouring residuals are alike: judged from one time block to another, not from sample to sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.identification.least_squares import Estimate
from asbuilt.identification.square_root_information import SquareRootInformation

Array = NDArray[np.float64]

FEWEST_BLOCKS = 8
"""With fewer blocks their scatter says nothing."""
MOST_LEVERAGE = 0.999
"""Share of what is known of a direction that may come from one block before its leave-one-out value stops moving further."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Hold the covariance (p, p) of an estimate, and how many independent samples the recording is worth.

    `method` is `"blocks"`, or `"textbook"` where there were too few blocks; `n_blocks` is how many there were.
    """

    covariance: Array
    effective_samples: float
    method: str
    n_blocks: int

    @property
    def std_errors(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))


def block_uncertainty(information: SquareRootInformation, estimate: Estimate) -> Uncertainty:
    """Judge the errors of an estimate by leaving out one time block after another.

    With `M_b = S^T W_b^T W_b S` and `g_b = S^T W_b^T e_b` of block b in coordinates where all blocks together have unit information (S the inverse root),
    leaving out block b moves the estimate by `d_b = -(1 - M_b)^-1 g_b`, and the variance of a parameter is `(B - 1) / B sum_b (S d_b)^2`: the
    delete-one-cluster jackknife, also called CR3 (Bell & McCaffrey, Survey Methodology, 2002; Cameron & Miller, J. Human Resources, 2015). It allows for any correlation within a
    block, across joints too. No variance is taken smaller than the textbook one, and correlations between parameters are the textbook ones, since B blocks cannot
    tell p (p - 1) / 2 of them.

    `effective_samples` = N times the geometric mean over parameters of textbook variance / variance.
    """
    n_blocks, n_samples = information.n_blocks, information.n_samples
    root = estimate.solution.inverse_root
    if n_blocks < FEWEST_BLOCKS or estimate.rank == 0:
        return Uncertainty(estimate.covariance, float(n_samples), "textbook", n_blocks)
    residual = np.append(-estimate.beta, 1.0)
    moves = np.empty((n_blocks, estimate.rank))
    for b in range(n_blocks):
        factor = information.block_stacked(b, estimate.weights)
        whitened = factor[:, :-1] @ root
        leverage, axes = np.linalg.eigh(whitened.T @ whitened)
        score = axes.T @ (whitened.T @ (factor @ residual))
        moves[b] = -axes @ (score / (1.0 - np.minimum(leverage, MOST_LEVERAGE)))
    jackknife = (n_blocks - 1) / n_blocks * np.sum((moves @ root.T) ** 2, axis=0)
    textbook = np.diag(estimate.covariance)
    variance = np.maximum(jackknife, textbook)
    told = textbook > 0
    swell = np.where(told, np.sqrt(variance / np.where(told, textbook, 1.0)), 1.0)
    shrinkage = float(np.exp(-2.0 * np.mean(np.log(swell[told])))) if told.any() else 1.0
    return Uncertainty(estimate.covariance * np.outer(swell, swell), n_samples * shrinkage, "blocks", n_blocks)
