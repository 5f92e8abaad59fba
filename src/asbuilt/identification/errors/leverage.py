"""Variances from the scatter of time blocks, corrected for the leverage of each block."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array

MOST_LEVERAGE = 0.999
"""Largest share of the information on a direction that one block is taken to have."""
TINY = 1e-300


def block_variances(inverse: Array, grams: Array, scores: Array) -> tuple[Array, Array]:
    """Return variances (m,) in multiples of those of `inverse`, and their degrees of freedom (m,).

    The m values x minimise `sum_b |e_b - C_b x|^2`, with `inverse` (m, m) that of the sum of the
    `grams` `C_b^T C_b` (B, m, m) and `scores` `C_b^T e_b` (B, m) of the residual. With
    `inverse = L L^T` and the leverage `H_b = L^T C_b^T C_b L`, block b moves the values by
    `L (1 - H_b)^(-1/2) L^T C_b^T e_b` (CR2), and the degrees of freedom of a variance are those of
    independent residuals (Satterthwaite). Source: Bell & McCaffrey, Survey Methodology 28, 2002.

    Examples
    --------
    Blocks of equal share: one degree of freedom less than their number.

    >>> scores = np.array([[0.5], [-0.5], [0.5], [-0.5]])
    >>> block_variances(np.eye(1), np.full((4, 1, 1), 0.25), scores)
    (array([1.33333333]), array([3.]))
    """
    root = np.linalg.cholesky(inverse)
    leverage, axes = np.linalg.eigh(root.T @ grams @ root)
    leverage = np.clip(leverage, 0.0, MOST_LEVERAGE)
    turned = np.einsum("bji,bj->bi", axes, scores @ root) / np.sqrt(1.0 - leverage)
    moves = np.einsum("bij,bj->bi", axes, turned) @ root.T
    shares = np.einsum("bii->bi", inverse @ grams @ inverse) / np.diag(inverse)
    freedom = 1.0 / np.maximum(np.sum(shares**2, axis=0), TINY) - 1.0
    return np.sum(moves**2, axis=0) / np.diag(inverse), freedom
