"""Fits validated on time blocks held out in turn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from asbuilt.arrays import Array, Indices
from asbuilt.identification.information.square_root_information import SquareRootInformation

MOST_FOLDS = 8
MOST_SORTED = 500
"""Blocks whose distances are compared; of more, the others join the nearest group."""
DIFFERENT_MOTIONS = 6
"""Groups of different motion that are held out; each is then about a sixth of a recording."""


def group_neighbours(n_blocks: int, n_groups: int = MOST_FOLDS) -> list[Indices]:
    """Return the blocks in groups of neighbours, so that lasting residuals do not leak."""
    count = min(n_groups, n_blocks)
    # Parts that differ by one block at most.
    number = np.arange(n_blocks) * count // max(n_blocks, 1)
    return [np.flatnonzero(number == group) for group in range(count)]


def group_different_motions(
    information: SquareRootInformation, weights: Array, most: int = DIFFERENT_MOTIONS
) -> list[Indices]:
    """Return the blocks in groups of like motion, so that no twin of a held-out block is left.

    Blocks are alike if their information per sample is, in parameters scaled to equal torque
    (Ward's linkage; Ward, J. American Statistical Association 58, 1963).
    """
    roots = (information.stacked(weights, b)[:, :-1] for b in range(information.n_blocks))
    return group_motions(
        np.array([root.T @ root for root in roots]),
        np.array([block.n_samples for block in information.blocks]),
        most,
    )


def group_motions(grams: Array, n_samples: Array, most: int = DIFFERENT_MOTIONS) -> list[Indices]:
    """Return blocks of information (B, p, p) and so many samples (B,) in groups of like motion."""
    if len(grams) <= 2:
        return group_neighbours(len(grams))
    length = np.sqrt(np.diag(grams.sum(axis=0)))
    # Equal torque per parameter: a distance between informations then has no units.
    scale = np.where(length > 0.0, length, 1.0) / np.sqrt(n_samples.sum())
    # A column that is never excited has no length, and stays zero.
    scaled = grams / np.outer(scale, scale)
    features = scaled[:, *np.triu_indices(len(scale))] / n_samples[:, None]
    # Ward's linkage takes the square of the blocks in memory.
    every = -(-len(grams) // MOST_SORTED)
    group = fcluster(linkage(features[::every], "ward"), most, "maxclust")
    if every > 1:
        means = np.array([features[::every][group == k].mean(axis=0) for k in np.unique(group)])
        group = np.argmin(cdist(features, means), axis=1)
    return [np.flatnonzero(group == each) for each in np.unique(group)]


def divide_into_folds(
    information: SquareRootInformation, groups: Sequence[Indices] | None = None
) -> Iterator[tuple[SquareRootInformation, SquareRootInformation]]:
    """Yield the blocks to train on and those held out, group by group; nothing for one group."""
    every = np.arange(information.n_blocks)
    groups = group_neighbours(information.n_blocks) if groups is None else groups
    # Nothing is left to train on without another group.
    for group in groups if len(groups) > 1 else ():
        yield information.select(np.setdiff1d(every, group)), information.select(group)


def measure_held_out_errors(
    information: SquareRootInformation,
    fit: Callable[[SquareRootInformation], Array],
    groups: Sequence[Indices] | None = None,
) -> tuple[Array, Array]:
    """Return squared torque errors (n_folds, n) on held-out groups, and each beta (n_folds, p)."""
    betas = []
    errors = []
    for training, held in divide_into_folds(information, groups):
        betas.append(fit(training))
        errors.append(held.residual_energy(betas[-1]) / held.n_samples)
    return np.array(errors), np.array(betas)
