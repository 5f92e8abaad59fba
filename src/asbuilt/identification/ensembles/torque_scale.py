"""How base parameters follow the torque scale of single joints, such as a servo's stiffness."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.result.result import IdentificationResult

RESOLUTION = 1e-12
"""Scaled information relative to the largest below which a direction is undetermined."""


def torque_scale_slopes(result: IdentificationResult) -> Array | None:
    """Return the derivatives (n, p) of base parameters by the logarithms of the torque scales.

    Least squares with weights `1 / sigma_k` gives `A d beta / d ln s_k = W_k^T tau_k / sigma_k^2`,
    `A = sum_k W_k^T W_k / sigma_k^2`. All slopes add up to beta, since a scale that all joints
    share scales every parameter. None if the result has no cause data.
    """
    data = result.cause_data
    if data is None:
        return None
    places = data.places(result.base.names)
    A, right = np.zeros((len(places), len(places))), []
    for factor, sigma in zip(data.whole(data.fitted), result.sigma, strict=True):
        R = factor[:, places] / sigma
        A += R.T @ R
        right.append(R.T @ factor[:, -1] / sigma)
    size = np.sqrt(np.maximum(np.diag(A), np.finfo(np.float64).tiny))
    inverse = np.linalg.pinv(A / np.outer(size, size), rcond=RESOLUTION, hermitian=True)
    slopes = np.stack(right) @ (inverse / np.outer(size, size))
    return np.asarray(slopes + (result.estimates - slopes.sum(axis=0)) / len(slopes))
