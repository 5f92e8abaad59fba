"""Merging of neighbouring time blocks in a fixed tree."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics import use_one_blas_thread
from asbuilt.identification import SquareRootInformation, TimeBlock, triangular_factor


def merge_factors(factors: Array) -> Array:
    """Return one factor (q, q) of several (m, q, q), merged pair by pair.

    The tree depends on m alone, so the result is the same to the last bit wherever it is made; an
    entry takes part in log2(m) mergers, not in m.
    """
    while len(factors) > 1:
        pairs = factors[: len(factors) // 2 * 2].reshape(-1, 2 * factors.shape[1], factors.shape[2])
        merged = np.array([triangular_factor(pair) for pair in pairs])
        factors = np.concatenate([merged, factors[2 * len(pairs) :]])
    return np.asarray(factors[0])


def merge_blocks(information: SquareRootInformation, most: int) -> SquareRootInformation:
    """Return the information with at most `most` blocks, equal numbers of neighbours merged.

    Blocks of different recordings are merged too where there are more recordings than `most`.
    """
    n = information.n_blocks
    if n <= most:
        return information
    edges = np.linspace(0, n, most + 1).round().astype(int).tolist()
    groups = list(pairwise(edges))
    with use_one_blas_thread():
        factors = tuple(
            np.array([merge_factors(factor[first:last]) for first, last in groups])
            for factor in information.factors
        )
    sums = [information.torque_sum[first:last].sum(axis=0) for first, last in groups]
    times = [TimeBlock.spanning(information.blocks[first:last]) for first, last in groups]
    return replace(information, factors=factors, torque_sum=np.array(sums), blocks=tuple(times))
