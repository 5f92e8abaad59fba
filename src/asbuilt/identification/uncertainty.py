"""Standard errors that hold although neighbouring residuals are alike: judged from one time block to another, not from sample to sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.identification.least_squares import Estimate
from asbuilt.identification.square_root_information import SquareRootInformation

Array = NDArray[np.float64]

FEWEST_BLOCKS = 8
"""With fewer blocks their scatter says nothing."""
MOST_LEVERAGE = 0.999
"""Share of what is known of a direction that may come from one block; a larger share is taken as this one."""


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
    """Judge the errors of an estimate by how much each time block pulls at it.

    With `M_b = S^T W_b^T W_b S` and `g_b = S^T W_b^T e_b` of block b, in coordinates where all blocks together have unit information (S the inverse
    root), the variance of a parameter is `sum_b (S (1 - M_b)^(-1/2) g_b)^2`: the cluster-robust covariance CR2, unbiased where residuals are independent
    after all (Bell & McCaffrey, Survey Methodology 28, 2002; Pustejovsky & Tipton, J. Business & Economic Statistics 36, 2018). It allows for any correlation
    within a block, across joints too. No variance is taken smaller than the textbook one, and correlations between parameters are the textbook ones,
    since B blocks cannot tell p (p - 1) / 2 of them.

    `effective_samples` = N times the geometric mean over parameters of textbook variance / variance.
    """
    n_blocks, n_samples = information.n_blocks, information.n_samples
    root = estimate.solution.inverse_root
    if n_blocks < FEWEST_BLOCKS or estimate.rank == 0:
        return Uncertainty(estimate.covariance, float(n_samples), "textbook", n_blocks)
    residual = np.append(-estimate.beta, 1.0)
    moves = np.empty((n_blocks, root.shape[1]))
    with one_blas_thread():
        for b in range(n_blocks):
            factor = information.block_stacked(b, estimate.weights)
            whitened = factor[:, :-1] @ root
            leverage, axes = np.linalg.eigh(whitened.T @ whitened)
            score = axes.T @ (whitened.T @ (factor @ residual))
            moves[b] = axes @ (score / np.sqrt(1.0 - np.minimum(leverage, MOST_LEVERAGE)))
    clustered = np.sum((moves @ root.T) ** 2, axis=0)
    textbook = np.diag(estimate.covariance)
    variance = np.maximum(clustered, textbook)
    told = textbook > 0
    swell = np.where(told, np.sqrt(variance / np.where(told, textbook, 1.0)), 1.0)
    shrinkage = float(np.exp(-2.0 * np.mean(np.log(swell[told])))) if told.any() else 1.0
    return Uncertainty(estimate.covariance * np.outer(swell, swell), n_samples * shrinkage, "blocks", n_blocks)
