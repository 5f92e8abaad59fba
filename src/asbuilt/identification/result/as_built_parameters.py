"""Information about base parameters in a result, and standard parameters of the robot as built."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.bodies.standard_parameters import (
    StandardParameters,
    find_standard_parameters,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.scaled import Scaled


def scale_covariance(result: IdentificationResult) -> Scaled:
    """Return the covariance of a result in the directions that it determines.

    Its inverse is the information: dropped parameters have none, nor have directions beyond the
    rank of least squares; estimates regularised toward CAD have a variance in all.
    """
    return Scaled(np.array(result.covariance))


def known_information(result: IdentificationResult) -> Array:
    """Return the information matrix (p, p) of a result: the pseudo-inverse of its covariance.

    Undetermined directions and dropped parameters carry no information. The information allows for
    correlated residuals, since the standard errors do.
    """
    return scale_covariance(result).pseudo_inverse


def find_estimable_root(result: IdentificationResult, covariance: Array) -> Array:
    """Return R (r, p), `R^T R` the information of a covariance (p, p), of what is determined.

    The r directions T (r, p) with variances `T C T^T` are those that the torques of the data show;
    what these leave open has no row, whatever variance further errors gave it.
    """
    size = np.sqrt(np.diag(covariance))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    seen = np.diag(scale)
    if result.rank < result.n_base:
        information = _add_up_torque_information(result)
        columns = np.sqrt(np.diag(information))
        inverse = np.divide(1.0, columns, out=np.zeros_like(columns), where=columns > 0)
        _, axes = np.linalg.eigh(information * np.outer(inverse, inverse))
        seen = axes[:, result.n_base - result.rank :].T * columns
    variances, directions = np.linalg.eigh(seen @ covariance @ seen.T)
    # Rounding of the smallest variances, so that no direction is known without any error.
    least = len(variances) * np.finfo(float).eps * variances.max(initial=0.0)
    return np.asarray(directions.T / np.sqrt(np.maximum(variances, least))[:, None] @ seen)


def as_built_parameters(result: IdentificationResult, nearest: bool = False) -> StandardParameters:
    """Return the standard parameters closest to CAD within the noise of the data of a result.

    They have its torques: that errors are larger than the noise, since residuals are correlated or
    effects are missing, is no reason to predict torques worse. If no physically consistent links
    have its torques, they are inconsistent, or, with `nearest`, the consistent ones with the least
    torque difference on the data used, joints weighted by their noise.
    """

    def find() -> StandardParameters:
        return find_standard_parameters(
            result.model,
            result.base,
            result.estimates,
            nearest=nearest,
            information=_add_up_torque_information(result),
            # With what held the fit where torques are silent: a friction that no motion shows is
            # next to zero, and would be anything.
            noise_root=Scaled(np.array(result.textbook_covariance)).inverse_root.T,
        )

    return result.once((as_built_parameters, nearest), find)


def _add_up_torque_information(result: IdentificationResult) -> Array:
    """Return A (p, p) with `d^T A d = sum_k |W_k d|^2 / sigma_k^2` on the data used.

    From the cause data, or else the inverse of the textbook covariance.
    """
    if result.cause_data is not None:
        places = result.cause_data.places(result.base.names)
        # Least noise of a joint relative to the largest; its weight grows no further (simulations).
        quietest = np.finfo(np.float64).tiny + 1e-6 * float(
            result.sigma[np.isfinite(result.sigma)].max(initial=0.0)
        )
        factors = result.cause_data.whole(result.cause_data.fitted)
        pairs = zip(factors, np.maximum(result.sigma, quietest), strict=True)
        rows = [factor[:, places] / sigma for factor, sigma in pairs]
        return np.asarray(sum(R.T @ R for R in rows))
    return Scaled(np.array(result.textbook_covariance)).pseudo_inverse
