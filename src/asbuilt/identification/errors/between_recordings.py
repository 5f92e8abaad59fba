"""How much parameters differ from recording to recording, beyond what their time blocks show."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.errors.block_scatter import widening
from asbuilt.identification.errors.uncertainty import block_scores, corrected_moves
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation

FEWEST_RECORDINGS = 4
"""Recordings below which their scatter gives no usable variance."""


def recording_variances(information: SquareRootInformation, estimate: Estimate) -> Array:
    """Return the variances (p,) of base parameters with whole recordings as clusters.

    Blocks of one recording share what the model lacks in its motion, such as a law of the servo
    that only steps show; then the scatter of blocks is too small, and that of recordings is not
    (CR2, as in `block_uncertainty`, Student's quantile of its few degrees of freedom included).
    Zero if there are fewer than `FEWEST_RECORDINGS`.
    """
    sources = [block.source for block in information.blocks]
    names = list(dict.fromkeys(sources))
    if len(names) < FEWEST_RECORDINGS or estimate.rank == 0:
        return np.zeros(len(estimate.beta))
    number = np.array([names.index(each) for each in sources])
    grams, scores = block_scores(information, estimate)
    members = [number == k for k in range(len(names))]
    root = estimate.solution.inverse_root
    found = corrected_moves(
        np.array([grams[each].sum(axis=0) for each in members]),
        np.array([scores[each].sum(axis=0) for each in members]),
        root,
    )
    variance = np.sum((found.moves @ root.T) ** 2, axis=0)
    return np.asarray(variance * widening(found.freedom) ** 2)
