"""What an identification knows already, as information about the base parameters: what a further motion need not tell again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from asbuilt.identification.result import IdentificationResult

Array = NDArray[np.float64]


def known_information(result: IdentificationResult) -> Array:
    """Return the information matrix (p, p) behind a result: the pseudo-inverse of its covariance, of the result's rank, in scaled columns.

    Directions that the recording does not tell carry no information, nor do dropped parameters, which were set and not measured: a further motion may tell
    them. The standard errors allow for correlated residuals, so the information does, too.
    """
    covariance = np.array(result.covariance)
    size = np.sqrt(np.diag(covariance))
    told = size > 0
    scale = np.where(told, 1.0 / np.where(told, size, 1.0), 0.0)
    eigenvalues, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    kept = eigenvalues > max(eigenvalues[-1], 0.0) * len(eigenvalues) * np.finfo(float).eps
    kept[: max(0, len(eigenvalues) - result.rank)] = False
    inverse = (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].T
    information: Array = inverse * np.outer(scale, scale)
    return information
